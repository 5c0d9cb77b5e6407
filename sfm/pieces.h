// The groups that a capture falls into: photos that were mapped together, and what matches between groups.
#pragma once

#include <filesystem>
#include <string>
#include <utility>
#include <vector>

#include "pipeline/json.h"
#include "sfm/capture.h"
#include "sfm/colmap_database.h"
#include "sfm/colmap_model.h"

namespace nrff {

// Matches by which a pair of photos holds two groups together: COLMAP places no photo by fewer points.
inline constexpr int kHoldingMatches = 30;
inline constexpr size_t kLeastPiece = 3;  // photos

struct Piece {
  std::vector<int> photos;  // indices into the capture's, ascending
  size_t n_points = 0;
};

struct Pieces {
  std::vector<Piece> pieces;   // largest first
  std::vector<int> elsewhere;  // photos of none
  // Pairs of photos of two pieces: matched, with kHoldingMatches and more, the most of any, and of which.
  int n_pairs = 0, n_holding = 0, most_matches = 0;
  std::pair<int, int> closest{-1, -1};  // indices into the capture's photos; where most_matches > 0

  int NumPlaced() const;
};

// A photo that is in several models counts for the largest of them. `models` of working photos.
Pieces FindPieces(const Capture& capture, const ColmapDatabase& database, const std::vector<ColmapModel>& models);

// "a.jpg to c.jpg, f.jpg": what follows each other in the capture as one; the rest of many is counted.
std::string PhotoRanges(const Capture& capture, const std::vector<int>& photos);

// Of a capture of two and more: which groups there are; and, in sentences without the last's full stop, what matches
// between them and what to do. `lists`: where WritePieceLists wrote.
std::string DescribePieces(const Capture& capture, const Pieces& pieces);
std::string AdviseOnPieces(const Capture& capture, const Pieces& pieces, const std::filesystem::path& lists);

// [{n_images, n_points, photos: PhotoRanges}]
Json PiecesJson(const Capture& capture, const Pieces& pieces);

// The paths of every piece's photos below the capture, one a line: 1.txt, 2.txt, … in `dir`, which is made anew.
void WritePieceLists(const Capture& capture, const Pieces& pieces, const std::filesystem::path& dir);

}  // namespace nrff
