// The scene map: affine, and contracted beyond the foreground.

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <random>
#include <string>

#include "render/scene_map.h"
#include "tests/stability/table.h"

namespace nrff::stability {
namespace {

template <typename Scalar>
class Contraction : public testing::Test {};
using Scalars = testing::Types<float, double>;
TYPED_TEST_SUITE(Contraction, Scalars);

TYPED_TEST(Contraction, SeamAndInfinity) {
  const SceneMap map = SceneMap::FromBox({-1, -1, -1}, {1, 1, 1}, /*unbounded=*/true);
  const auto along_x = [&](TypeParam x) {
    const TypeParam scene[3] = {x, TypeParam(0.25) * x, 0};
    TypeParam field[3];
    map.ToField(scene, field);
    return field[0];
  };
  const TypeParam above = std::nextafter(TypeParam(1), TypeParam(2)),
                  below = std::nextafter(TypeParam(1), TypeParam(0));
  Hold("contraction", "jump at the seam", kFormat<TypeParam>, std::abs(double(along_x(above)) - along_x(below)),
       8 * kUnit<TypeParam>);
  double most = 0;
  for (const double far : {1e3, 1e18, double(std::numeric_limits<TypeParam>::max()), HUGE_VAL}) {
    most = std::max(most, std::abs(std::abs(double(along_x(TypeParam(-far)))) - (1 - 0.5 / far)));
  }
  Hold("contraction", "|field| − (1 − 1/2m)", std::string(kFormat<TypeParam>) + ", m 1e3 to infinity", most,
       8 * kUnit<TypeParam>);
}

// scene → field → scene. Field coordinates near 1 leave u/(1 − |field|) = 2um of a point at m.
TYPED_TEST(Contraction, RoundTripsInBoxesOfAnySize) {
  std::mt19937_64 random(1);
  std::uniform_real_distribution<double> unit(-1, 1);
  for (const bool unbounded : {false, true}) {
    Worst worst;
    for (const double width : {1e-6, 1., 1e7}) {
      for (const double offset : {0., 1e7}) {
        if (offset / width > 0.01 / kUnit<TypeParam>) continue;  // the box is not resolved by the format
        const SceneMap map = SceneMap::FromBox({offset - width, offset - width, offset - width},
                                               {offset + width, offset + width, offset + width}, unbounded);
        for (int i = 0; i < 1000; ++i) {
          const double m = unbounded ? std::pow(10, 2 * std::abs(unit(random))) : 1;
          TypeParam scene[3], field[3], again[3];
          for (TypeParam& coordinate : scene) coordinate = TypeParam(offset + width * m * unit(random));
          map.ToField(scene, field);
          map.ToScene(field, again);
          for (int k = 0; k < 3; ++k) {
            worst.Add(std::abs(double(again[k]) - scene[k]),
                      kUnit<TypeParam> * (16 * (unbounded ? 1 + 2 * m : 1) * width * m + 8 * (offset + width * m)));
          }
        }
      }
    }
    worst.Hold("contraction", unbounded ? "scene → field → scene, contracted" : "scene → field → scene, affine",
               std::string(kFormat<TypeParam>) + ", boxes 1e-6 to 1e7 wide, up to 1e7 from the origin");
  }
}

}  // namespace
}  // namespace nrff::stability
