#include "model/camera_corrections.h"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

namespace nrff {
namespace {

Eigen::Matrix3d RotationOf(const Vec3& turn) {
  const Eigen::Vector3d vector(turn.data());
  const double angle = vector.norm();
  if (angle == 0) return Eigen::Matrix3d::Identity();
  return Eigen::AngleAxisd(angle, vector / angle).toRotationMatrix();
}

// [R(turn) | shift]
Mat4 Motion(const PoseCorrection& pose) {
  const Eigen::Matrix3d rotation = RotationOf(pose.turn);
  Mat4 motion{};
  for (size_t row = 0; row < 3; ++row) {
    for (size_t column = 0; column < 3; ++column)
      motion[4 * row + column] = rotation(Eigen::Index(row), Eigen::Index(column));
    motion[4 * row + 3] = pose.shift[row];
  }
  motion[15] = 1;
  return motion;
}

double Finite(const Json& json) {
  const auto value = json.get<double>();
  if (!std::isfinite(value)) throw std::invalid_argument("a camera correction is not finite");
  return value;
}

}  // namespace

void PoseCorrection::Append(const Vec3& further_turn, const Vec3& further_shift) {
  const Eigen::Matrix3d rotation = RotationOf(turn);
  const Eigen::AngleAxisd turned(rotation * RotationOf(further_turn));
  const Eigen::Vector3d moved = rotation * Eigen::Vector3d(further_shift.data());
  for (int k = 0; k < 3; ++k) {
    turn[size_t(k)] = turned.angle() * turned.axis()[k];
    shift[size_t(k)] += moved[k];
  }
}

CameraCorrections CameraCorrections::None(const std::vector<View>& training) {
  CameraCorrections none;
  for (const View& view : training) {
    none.poses.push_back({view.id, {}, {}});
    if (none.KindOf(view) == none.intrinsics.size()) {
      none.intrinsics.push_back({view.width, view.height, view.fx, view.fy, view.cx, view.cy});
    }
  }
  return none;
}

CameraCorrections CameraCorrections::Of(const std::vector<View>& training) const {
  CameraCorrections all = None(training);
  for (PoseCorrection& pose : all.poses) {
    const auto known = std::find_if(poses.begin(), poses.end(), [&](const auto& of) { return of.view == pose.view; });
    if (known != poses.end()) pose = *known;
  }
  for (IntrinsicsCorrection& inner : all.intrinsics) {
    const auto known = std::find_if(intrinsics.begin(), intrinsics.end(),
                                    [&](const IntrinsicsCorrection& of) { return of.Given() == inner.Given(); });
    if (known != intrinsics.end()) inner = *known;
  }
  return all;
}

size_t CameraCorrections::KindOf(const View& view) const {
  const auto given = std::tie(view.width, view.height, view.fx, view.fy, view.cx, view.cy);
  const auto found =
      std::find_if(intrinsics.begin(), intrinsics.end(), [&](const auto& inner) { return inner.Given() == given; });
  return size_t(found - intrinsics.begin());
}

View CameraCorrections::Corrected(View view) const {
  if (const size_t kind = KindOf(view); kind < intrinsics.size()) {
    const IntrinsicsCorrection& inner = intrinsics[kind];
    view.fx *= std::exp(inner.log_focal);
    view.fy *= std::exp(inner.log_focal);
    view.cx += inner.shift_x;
    view.cy += inner.shift_y;
  }
  const auto pose = std::find_if(poses.begin(), poses.end(), [&](const auto& of) { return of.view == view.id; });
  if (pose != poses.end()) view.scene_from_camera = Multiply(view.scene_from_camera, Motion(*pose));
  return view;
}

void to_json(Json& json, const CameraCorrections& corrections) {
  json = {{"poses", Json::array()}, {"intrinsics", Json::array()}};
  for (const PoseCorrection& pose : corrections.poses)
    json["poses"].push_back({{"view", pose.view}, {"turn", pose.turn}, {"shift", pose.shift}});
  for (const IntrinsicsCorrection& inner : corrections.intrinsics) {
    json["intrinsics"].push_back({{"size", {inner.width, inner.height}},
                                  {"given", {inner.fx, inner.fy, inner.cx, inner.cy}},
                                  {"log_focal", inner.log_focal},
                                  {"shift", {inner.shift_x, inner.shift_y}}});
  }
}

void from_json(const Json& json, CameraCorrections& corrections) {
  corrections = {};
  for (const Json& pose : json.at("poses")) {
    PoseCorrection& of = corrections.poses.emplace_back();
    of.view = pose.at("view").get<std::string>();
    for (size_t k = 0; k < 3; ++k) {
      of.turn[k] = Finite(pose.at("turn").at(k));
      of.shift[k] = Finite(pose.at("shift").at(k));
    }
  }
  for (const Json& inner : json.at("intrinsics")) {
    const Json &size = inner.at("size"), &given = inner.at("given"), &shift = inner.at("shift");
    corrections.intrinsics.push_back({size.at(0).get<int>(), size.at(1).get<int>(), Finite(given.at(0)),
                                      Finite(given.at(1)), Finite(given.at(2)), Finite(given.at(3)),
                                      Finite(inner.at("log_focal")), Finite(shift.at(0)), Finite(shift.at(1))});
  }
}

Json CorrectedCamerasJson(const Scene& scene, const CameraCorrections& corrections,
                          const std::vector<double>& displacement_px) {
  Json views = Json::array();
  size_t n_training = 0;
  for (const View& given : scene.views) {
    const View view = corrections.Corrected(given);
    const bool training = view.split == Split::kTrain;
    views.push_back({{"id", view.id},
                     {"name", view.name},
                     {"split", training ? "train" : "test"},
                     {"width", view.width},
                     {"height", view.height},
                     {"fx", view.fx},
                     {"fy", view.fy},
                     {"cx", view.cx},
                     {"cy", view.cy},
                     {"scene_from_camera", view.scene_from_camera}});
    if (training && n_training < displacement_px.size())
      views.back()["displacement_px"] = displacement_px[n_training++];
  }
  return {{"schema_version", kCamerasSchemaVersion}, {"views", views}};
}

}  // namespace nrff
