// Where the arithmetic of training and rendering runs.
#pragma once

namespace nrff {

// Threads of the kernels and of torch, which share one OpenMP pool; ≤ 0: one per core this process may use. Returns
// the number.
int SetThreads(int n_threads);

}  // namespace nrff
