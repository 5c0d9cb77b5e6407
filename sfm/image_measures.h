// What is measured on photos: sharpness, likeness, whether their order is the order of taking.
#pragma once

#include <bitset>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "sfm/image_io.h"

namespace nrff {

// Variance of the Laplacian (4-neighbour kernel, grey levels 0 to 255) after reducing the longer side to 512 px by area
// averaging; smaller photos stay as they are. Higher is sharper; figures compare within one capture.
double MeasureBlur(const Image& image);

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
