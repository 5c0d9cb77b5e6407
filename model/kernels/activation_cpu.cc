#include "model/kernels/activation.h"

namespace nrff {

NRFF_MULTIVERSION void ActivateRow(Activation activation, int64_t n, float* row, float* derivative) {
  ActivateInline(activation, n, row, derivative);
}

}  // namespace nrff
