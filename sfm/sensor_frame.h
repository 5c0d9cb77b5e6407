// Photos as their sensor had them. EXIF turns a photo for display, but not the lens that took it: COLMAP works on
// photos as they were taken, so that a camera's upright and turned photos share its lens, and what it finds is then
// turned as the photos are displayed.
//
// Turns are quarter turns to the right. Photos that EXIF mirrors count as taken as they are displayed: no pose mirrors.
#pragma once

#include <utility>

#include "sfm/colmap_model.h"
#include "sfm/image_io.h"

namespace nrff {

int QuarterTurns(int orientation);  // from the sensor's raster to the displayed one, 0 to 3; EXIF orientation 1 to 8

std::pair<int, int> SensorSize(const ImageInfo& photo);  // width and height, px
Image AsSensorHadIt(Image displayed, int orientation);

// Sees a camera's rays, turned, where the turned photo shows them.
ColmapCamera TurnedCamera(ColmapCamera camera, int quarter_turns);

// Pose and observations; `width` and `height`: of the photo before, px.
void TurnImage(ColmapImage& image, int width, int height, int quarter_turns);

}  // namespace nrff
