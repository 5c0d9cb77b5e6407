#include "render/compute.h"

#include <ATen/Parallel.h>
#include <omp.h>

namespace nrff {

int SetThreads(int n_threads) {
  if (n_threads <= 0) n_threads = omp_get_num_procs();
  omp_set_num_threads(n_threads);
  at::set_num_threads(n_threads);
  return n_threads;
}

}  // namespace nrff
