// What tests can set and ask of the emulated device (device_runtime.h).
#pragma once

#include <cstddef>

namespace nrff::device {

// How much memory the device has; the most that was used is counted anew.
void SetEmulatedMemory(size_t bytes);
size_t MostEmulatedMemoryUsed();

}  // namespace nrff::device
