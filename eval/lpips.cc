#include "eval/lpips.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>
#include <opencv2/dnn.hpp>
#include <set>
#include <stdexcept>
#include <utility>
#include <vector>

#include "eval/onnx_reader.h"
#include "pipeline/error.h"
#include "pipeline/files.h"

namespace nrff {
namespace {

constexpr int kLayers = 5;
constexpr char kLayout[] = "1";

// Channels of the five layers of the published backbones.
const std::map<std::string, std::vector<size_t>>& Backbones() {
  static const std::map<std::string, std::vector<size_t>> kBackbones = {{"vgg", {64, 128, 256, 512, 512}},
                                                                        {"alex", {64, 192, 384, 256, 256}}};
  return kBackbones;
}

Error CannotBeUsed(const std::filesystem::path& file, const std::string& why) {
  return InputError("LPIPS network " + EscapePath(file) + " cannot be used: " + why +
                    "; make it with eval/export_lpips.py");
}

std::string FeatureName(int layer) { return "feature" + std::to_string(layer); }

std::string MetadataOf(const OnnxModel& model, const char* key) {
  const auto found = model.metadata.find(key);
  if (found == model.metadata.end()) throw std::runtime_error(std::string("it does not say its ") + key);
  return found->second;
}

std::string HashOf(const OnnxModel& model) {
  std::string bytes;
  for (const OnnxTensor& constant : model.constants) (bytes += constant.name) += constant.bytes;
  return HashBytes(bytes);
}

std::vector<float> WeightsOf(const OnnxModel& model, int layer) {
  const std::string name = "weight" + std::to_string(layer);
  for (const OnnxTensor& constant : model.constants) {
    if (constant.name != name) continue;
    if (constant.shape.size() != 1) throw std::runtime_error("its " + name + " is no row of numbers");
    std::vector<float> weights(constant.bytes.size() / sizeof(float));
    std::memcpy(weights.data(), constant.bytes.data(), constant.bytes.size());
    // NaN is none either.
    const auto usable = [](float weight) { return weight >= 0 && std::isfinite(weight); };
    if (!std::all_of(weights.begin(), weights.end(), usable)) {
      throw std::runtime_error("its " + name + " has a negative number or one that is not finite");
    }
    return weights;
  }
  throw std::runtime_error("it has no " + name);
}

void CheckGraph(const OnnxModel& model) {
  const std::set<std::string> known = {"Mul", "Add", "Conv", "Relu", "MaxPool"};
  for (const std::string& kind : model.operators) {
    if (!known.contains(kind)) throw std::runtime_error("it has the operator " + kind + ", which no backbone has");
  }
  std::vector<std::string> expected;
  expected.reserve(kLayers);
  for (int layer = 0; layer < kLayers; ++layer) expected.push_back(FeatureName(layer));
  if (model.outputs != expected) throw std::runtime_error("its outputs are not feature0 to feature4");
}

cv::Mat ToBlob(const RgbImage& image) {
  const int sizes[] = {1, 3, image.height, image.width};
  cv::Mat blob(4, sizes, CV_32F);
  const size_t n = size_t(image.width) * image.height;
  auto* to = blob.ptr<float>();
  for (size_t c = 0; c < 3; ++c) {
    for (size_t i = 0; i < n; ++i) to[c * n + i] = float(image.rgb[3 * i + c]);
  }
  return blob;
}

// 1 / (length of a pixel's features + 1e-10), as the lpips package has it.
std::vector<double> InverseLengths(const float* features, size_t n_channels, size_t n_pixels) {
  std::vector<double> lengths(n_pixels, 0.);
  for (size_t c = 0; c < n_channels; ++c) {
    const float* row = features + c * n_pixels;
    for (size_t i = 0; i < n_pixels; ++i) lengths[i] += double(row[i]) * row[i];
  }
  for (double& length : lengths) length = 1 / (std::sqrt(length) + 1e-10);
  return lengths;
}

}  // namespace

struct LpipsNetwork::Runner {
  cv::dnn::Net net;
  std::vector<float> weights[kLayers];
  std::vector<cv::String> outputs;

  std::vector<cv::Mat> Features(const RgbImage& image) {
    net.setInput(ToBlob(image), "image");
    std::vector<cv::Mat> features;
    net.forward(features, outputs);
    for (cv::Mat& layer : features) layer = layer.clone();  // the network's memory is used again
    return features;
  }
};

LpipsNetwork::LpipsNetwork(const std::filesystem::path& file) : file_(file), runner_(std::make_unique<Runner>()) {
  const std::string contents = ReadFile(file);
  try {
    const OnnxModel model = ReadOnnx(contents);
    const std::string layout = MetadataOf(model, "nrff_lpips");
    if (layout != kLayout) throw std::runtime_error("its layout is " + layout + ", expected " + kLayout);
    network_ = MetadataOf(model, "network");
    version_ = MetadataOf(model, "lpips_version");
    backbone_ = MetadataOf(model, "backbone");
    hash_ = MetadataOf(model, "hash");
    if (HashOf(model) != hash_) throw std::runtime_error("it is damaged: its constants do not have the hash it names");
    CheckGraph(model);
    for (int layer = 0; layer < kLayers; ++layer) {
      runner_->weights[layer] = WeightsOf(model, layer);
      runner_->outputs.push_back(FeatureName(layer));
    }
    const auto published = Backbones().find(network_);
    for (int layer = 0; published != Backbones().end() && layer < kLayers; ++layer) {
      if (runner_->weights[layer].size() != published->second[layer]) {
        throw std::runtime_error("its weight" + std::to_string(layer) + " does not have the channels of " + network_);
      }
    }
    runner_->net = cv::dnn::readNetFromONNX(contents.data(), contents.size());
    runner_->net.setPreferableBackend(cv::dnn::DNN_BACKEND_OPENCV);
  } catch (const cv::Exception& error) {
    throw CannotBeUsed(file, "OpenCV cannot read it (" + error.err + ")");
  } catch (const std::runtime_error& error) {
    throw CannotBeUsed(file, error.what());
  }
}

LpipsNetwork::~LpipsNetwork() = default;

void LpipsNetwork::RequirePublished() const {
  if (backbone_ == "published" && Backbones().contains(network_)) return;
  throw InputError("LPIPS network " + EscapePath(file_) + " has a " + backbone_ + " backbone (" + network_ +
                   "), whose figures are not LPIPS; make it with eval/export_lpips.py");
}

std::optional<double> LpipsNetwork::Distance(const RgbImage& truth, const RgbImage& rendered) {
  CheckPair(truth, rendered);
  if (std::min(truth.width, truth.height) < kLpipsSmallest) return std::nullopt;
  std::vector<cv::Mat> a, b;
  try {
    a = runner_->Features(truth);
    b = runner_->Features(rendered);
  } catch (const cv::Exception& error) {
    throw CannotBeUsed(file_, "OpenCV cannot run it on " + std::to_string(truth.width) + "×" +
                                  std::to_string(truth.height) + " px (" + error.err + ")");
  }
  double distance = 0;
  for (int layer = 0; layer < kLayers; ++layer) {
    const std::vector<float>& weights = runner_->weights[layer];
    if (a[layer].dims != 4 || size_t(a[layer].size[1]) != weights.size()) {
      throw CannotBeUsed(file_, "its " + FeatureName(layer) + " has another number of channels than its weights");
    }
    const size_t n_pixels = size_t(a[layer].size[2]) * a[layer].size[3];
    const auto *of_truth = a[layer].ptr<float>(), *of_rendered = b[layer].ptr<float>();
    const std::vector<double> truth_scale = InverseLengths(of_truth, weights.size(), n_pixels);
    const std::vector<double> rendered_scale = InverseLengths(of_rendered, weights.size(), n_pixels);
    double sum = 0;
    for (size_t c = 0; c < weights.size(); ++c) {
      double of_channel = 0;
      for (size_t i = 0; i < n_pixels; ++i) {
        const double off =
            of_truth[c * n_pixels + i] * truth_scale[i] - of_rendered[c * n_pixels + i] * rendered_scale[i];
        of_channel += off * off;
      }
      sum += weights[c] * of_channel;
    }
    distance += sum / double(n_pixels);
  }
  return distance;
}

}  // namespace nrff
