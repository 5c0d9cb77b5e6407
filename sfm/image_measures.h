// What is measured on photos: sharpness, likeness, a plain background, whether their order is the order of taking.
#pragma once

#include <bitset>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "pipeline/scene.h"
#include "sfm/image_io.h"

namespace nrff {

// Variance of the Laplacian (4-neighbour kernel, grey levels 0 to 255) after reducing the longer side to 512 px by area
// averaging; smaller photos stay as they are. Higher is sharper; figures compare within one capture.
double MeasureBlur(const Image& image);

// Shares of the pixels of a photo's frame, its outermost 2 % of the shorter side, that are nearly white (no channel
// below 230) and nearly black (none above 25). A photo of an object before a plain backdrop has a frame of one colour.
struct FrameShares {
  double white = 0, black = 0;
};
FrameShares MeasureFrame(const Image& image);

// The plain background of a capture: white or black where at least 70 % of the median photo's frame is. Measured:
// maryrose's white backdrop 83 %, the sky over sceaux_castle 23 %, the dark room around kermit 39 %.
Background PlainBackground(const std::vector<FrameShares>& frames);

// Difference hash: 17×16 grey means, one bit for each horizontal neighbour pair: left brighter than right.
using DifferenceHash = std::bitset<256>;
DifferenceHash HashDifferences(const Image& image);

// Groups (two or more indices, ascending) of images whose hashes differ in at most 1 % of the bits, transitively. A
// view moved by more than a few pixels is outside.
std::vector<std::vector<int>> GroupAlike(const std::vector<DifferenceHash>& hashes);

// Whether names in byte order are in the order of taking. Time stamps decide where all photos have one and they are
// not all the same: ordered if they never go back. Otherwise the last number in the name decides: ordered if the names
// agree in all but that number, it always grows, and by 3 or less on average (more is a selection at random).
bool IsOrdered(const std::vector<std::filesystem::path>& paths,
               const std::vector<std::optional<std::string>>& timestamps);

}  // namespace nrff
