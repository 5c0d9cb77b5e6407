// Lines that stages write of their progress.
#include <cmath>

#include "pipeline/progress.h"
#include "tests/fuzz/fuzz.h"

namespace nrff::fuzz {

std::vector<std::string> Seeds() {
  return {R"({"what":"training","done":120,"total":3000,"unit":"steps","seconds_left":41.2,"text":"loss 0.0123"})"};
}

}  // namespace nrff::fuzz

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  using namespace nrff;  // NOLINT(google-build-using-namespace)
  const auto update = ParseProgress({reinterpret_cast<const char*>(data), size});
  if (!update) return 0;
  fuzz::Require(std::isfinite(update->done) && std::isfinite(update->total), "progress is finite");
  fuzz::RequireText(update->what + update->unit + update->text, "");
  fuzz::RequireText(FormatSeconds(update->seconds_left.value_or(0)) + FormatBytes(update->done), "");
  return 0;
}
