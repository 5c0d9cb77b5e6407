// Which frames of a video are worth being photos of a capture: as far apart as the picture moves, not as time passes,
// and the sharpest of their surroundings. A pure function of what was measured.
#pragma once

#include <vector>

namespace nrff {

struct FrameMeasure {
  double sharpness = 0;  // MeasureSharpness (video_measures.h); figures compare within one video
  double motion = 0;     // of the picture since the frame before, in widths of the picture's longer side
};

enum class FrameVerdict { kKept, kRepeated, kBlurred, kNear };
inline constexpr const char* kFrameVerdicts[] = {"kept", "repeated", "blurred", "near"};  // in its order

// So far the picture moves from one kept frame to the next, in longer sides, where no number of frames is asked for. Of
// a video made of fox's 50 photos, a third of an object's orbit, one frame for 8 % of motion leaves out half of them,
// one for 3 % none (tests/bench/results/facilities.md).
inline constexpr double kMotionPerFrame = 0.03;
inline constexpr int kFewestFrames = 40, kMostFrames = 200;

// The motion of the whole video is cut into equal stretches, `n_wanted` of them (0: one per kMotionPerFrame, within
// kFewestFrames and kMostFrames), and of each the sharpest frame is kept, those near its middle before others. Not
// kept: a frame that shows the same as the kept one before it; one that is blurred against the kept ones around it.
// Where stretches have no frame, since the picture leapt, others give a second one. Of those that are not kept, the
// verdict says why: repeated (the picture stands still between it and a neighbour), blurred (less than kBlurred of the
// sharpness of the frame kept in its place), or near a kept frame.
std::vector<FrameVerdict> ChooseFrames(const std::vector<FrameMeasure>& frames, int n_wanted);

}  // namespace nrff
