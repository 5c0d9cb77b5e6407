// A small scene to train on, in tests: a shaded ball of radius 0.5 in front of white.
#pragma once

#include <gtest/gtest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "model/checkpoint.h"
#include "model/held_out.h"
#include "model/trainer.h"
#include "pipeline/files.h"
#include "render/compute.h"
#include "tests/temporary_directory.h"

namespace nrff {

inline constexpr int kBallViewSize = 32;  // px

// Six views of the ball around the equator to train on, two above to hold out; written to `dir`.
Scene WriteBallScene(const std::filesystem::path& dir);

// Points of the ball's front on rays of the training views.
std::vector<SparseDepth> BallDepths(const Scene& scene);

Preset BallPreset(int64_t steps);

class TrainTest : public ::testing::Test {
 protected:
  TrainTest() : scene_(WriteBallScene(directory_.path())), pack_(directory_.path()) { SetThreads(1); }

  // On the CPU, by the parameters that the state has.
  double HeldOutPsnr(const Trainer& trainer) const {
    const TrainState& state = trainer.state();
    const auto render = [&](const View& /*view*/, const Rays& rays) {
      return RenderRays(state.field, state.occupancy, state.map, rays, trainer.EvaluationOptions()).rgb;
    };
    return HeldOutViews(scene_, pack_, 1).Psnr(render, [&](const View& view) { return trainer.Corrected(view); });
  }
  // The bytes that SaveModel writes for the state.
  std::string ModelBytes(const Trainer& trainer) const {
    const TemporaryDirectory out;
    SaveModel(out.path(), trainer.state(), trainer.EvaluationOptions());
    return ReadFile(out.path() / kModelFile);
  }

  TemporaryDirectory directory_;
  Scene scene_;
  ImagePack pack_;
};

}  // namespace nrff
