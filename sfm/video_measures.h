// What is measured on the small grey pictures of a video's frames.
#pragma once

#include <cstdint>
#include <vector>

namespace nrff {

struct GreyPicture {
  int width = 0, height = 0;    // px
  std::vector<uint8_t> pixels;  // row-major
};

// Variance of the Laplacian over that of the picture itself: what blur takes from a picture, not how much there is to
// see in it. 0 for a picture of one grey.
double MeasureSharpness(const GreyPicture& picture);

// How far the picture moves from one frame to the next, in its longer sides: the median over a grid of blocks of the
// shift that phase correlation finds in each [Kuglin75]; blocks with nothing to hold on to do not count.
double MeasureMotion(const GreyPicture& before, const GreyPicture& after);

}  // namespace nrff
