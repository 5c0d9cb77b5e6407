// device_runtime.h on CUDA, with cuBLASLt for the products.

#include <cublasLt.h>
#include <cuda_runtime.h>

#include <cub/device/device_scan.cuh>
#include <map>
#include <memory>
#include <tuple>
#include <vector>

#include "render/kernels/device_runtime.h"

namespace nrff::device {
namespace {

void Check(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return;
  (void)cudaGetLastError();  // so that it is reported once
  throw DeviceError(std::string(what) + ": " + cudaGetErrorString(error));
}

void Check(cublasStatus_t status, const char* what) {
  if (status != CUBLAS_STATUS_SUCCESS) {
    throw DeviceError(std::string(what) + ": cuBLASLt status " + cublasLtGetStatusString(status));
  }
}

cudaEvent_t EventOf(void* event) { return static_cast<cudaEvent_t>(event); }

}  // namespace

OutOfDeviceMemory::OutOfDeviceMemory(size_t asked_bytes, size_t free_bytes)
    : DeviceError("out of GPU memory: " + std::to_string(asked_bytes >> 20) + " MiB were asked for, " +
                  std::to_string(free_bytes >> 20) + " MiB are free"),
      asked(asked_bytes),
      free(free_bytes) {}

DeviceFacts GetDeviceFacts() {
  int n_gpus = 0, device = 0;
  const cudaError_t error = cudaGetDeviceCount(&n_gpus);
  if (error != cudaSuccess || n_gpus == 0) {
    throw DeviceError(std::string("no GPU that CUDA can use: ") +
                      (error != cudaSuccess ? cudaGetErrorString(error) : "there is none"));
  }
  Check(cudaGetDevice(&device), "looking for a GPU");
  cudaDeviceProp properties{};
  Check(cudaGetDeviceProperties(&properties, device), "asking for the GPU's properties");
  DeviceFacts facts;
  facts.name = properties.name;
  facts.compute_capability = 10 * properties.major + properties.minor;
  Check(cudaMemGetInfo(&facts.free_bytes, &facts.memory_bytes), "asking for the GPU's memory");
  return facts;
}

void* Allocate(size_t bytes) {
  void* memory = nullptr;
  const cudaError_t error = cudaMalloc(&memory, bytes > 0 ? bytes : 1);
  if (error == cudaErrorMemoryAllocation) {
    (void)cudaGetLastError();
    size_t free = 0, total = 0;
    (void)cudaMemGetInfo(&free, &total);
    throw OutOfDeviceMemory(bytes, free);
  }
  Check(error, "allocating GPU memory");
  return memory;
}

void Free(void* memory) noexcept { (void)cudaFree(memory); }

void* AllocatePinned(size_t bytes) {
  void* memory = nullptr;
  Check(cudaMallocHost(&memory, bytes > 0 ? bytes : 1), "allocating pinned memory");
  return memory;
}

void FreePinned(void* memory) noexcept { (void)cudaFreeHost(memory); }

Stream::Stream() { Check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "making a stream"); }
Stream::~Stream() { (void)cudaStreamDestroy(stream_); }
void Stream::Synchronize() const { Check(cudaStreamSynchronize(stream_), "waiting for the GPU"); }

void CopyToDevice(void* to, const void* from, size_t bytes, CudaStream stream) {
  Check(cudaMemcpyAsync(to, from, bytes, cudaMemcpyHostToDevice, stream), "copying to the GPU");
}
void CopyToHost(void* to, const void* from, size_t bytes, CudaStream stream) {
  Check(cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToHost, stream), "copying from the GPU");
}
void Copy(void* to, const void* from, size_t bytes, CudaStream stream) {
  Check(cudaMemcpyAsync(to, from, bytes, cudaMemcpyDeviceToDevice, stream), "copying on the GPU");
}
void Zero(void* memory, size_t bytes, CudaStream stream) {
  const ProfileScope scope("clear", stream);
  Check(cudaMemsetAsync(memory, 0, bytes, stream), "clearing GPU memory");
}

Mark::Mark() {
  cudaEvent_t event = nullptr;
  Check(cudaEventCreateWithFlags(&event, cudaEventDisableTiming), "making an event");
  event_ = event;
}
Mark::~Mark() { (void)cudaEventDestroy(EventOf(event_)); }
void Mark::Record(CudaStream stream) { Check(cudaEventRecord(EventOf(event_), stream), "recording an event"); }
void Mark::Wait() const { Check(cudaEventSynchronize(EventOf(event_)), "waiting for the GPU"); }

namespace {

struct Profile {
  struct Entry {
    std::string what;
    cudaEvent_t begin, end;
  };
  std::vector<Entry> entries;
};
std::unique_ptr<Profile>& TheProfile() {
  static std::unique_ptr<Profile> profile;
  return profile;
}

}  // namespace

void StartProfile() { TheProfile() = std::make_unique<Profile>(); }

std::map<std::string, ProfiledWork> EndProfile() {
  std::map<std::string, ProfiledWork> works;
  const std::unique_ptr<Profile> profile = std::move(TheProfile());
  for (const Profile::Entry& entry : profile->entries) {
    Check(cudaEventSynchronize(entry.end), "waiting for the GPU");
    float milliseconds = 0;
    Check(cudaEventElapsedTime(&milliseconds, entry.begin, entry.end), "timing");
    ProfiledWork& work = works[entry.what];
    ++work.n;
    work.milliseconds += milliseconds;
    (void)cudaEventDestroy(entry.begin);
    (void)cudaEventDestroy(entry.end);
  }
  return works;
}

ProfileScope::ProfileScope(const char* what, CudaStream stream) : stream_(stream), recording_(TheProfile() != nullptr) {
  if (!recording_) return;
  Profile::Entry entry{what, nullptr, nullptr};
  Check(cudaEventCreate(&entry.begin), "making an event");
  Check(cudaEventCreate(&entry.end), "making an event");
  Check(cudaEventRecord(entry.begin, stream), "recording an event");
  TheProfile()->entries.push_back(entry);
}
ProfileScope::~ProfileScope() {
  if (recording_) (void)cudaEventRecord(TheProfile()->entries.back().end, stream_);
}

size_t ScratchOfSums(int64_t n) {
  size_t bytes = 0;
  Check(cub::DeviceScan::InclusiveSum(nullptr, bytes, static_cast<const int64_t*>(nullptr),
                                      static_cast<int64_t*>(nullptr), n),
        "sizing sums");
  return bytes;
}

void ExclusiveSums(const int64_t* values, int64_t n, int64_t* sums, void* scratch, size_t scratch_bytes,
                   CudaStream stream) {
  const ProfileScope scope("sums", stream);
  Check(cudaMemsetAsync(sums, 0, sizeof(int64_t), stream), "summing");
  Check(cub::DeviceScan::InclusiveSum(scratch, scratch_bytes, values, sums + 1, n, stream), "summing");
}

// What cuBLASLt needs to know of a shape.
struct Matmul::State {
  struct Plan {
    cublasLtMatmulDesc_t operation = nullptr;
    cublasLtMatrixLayout_t a = nullptr, b = nullptr, c = nullptr;
    cublasLtMatmulAlgo_t algorithm{};
  };
  using Key = std::tuple<int, bool, int64_t, int64_t, int64_t, int64_t, int64_t, int64_t, bool, bool>;

  explicit State(CudaStream s) : stream(s), workspace(kWorkspaceBytes) {
    Check(cublasLtCreate(&handle), "starting cuBLASLt");
  }
  ~State() {
    for (auto& [key, plan] : plans) {
      (void)cublasLtMatrixLayoutDestroy(plan.a);
      (void)cublasLtMatrixLayoutDestroy(plan.b);
      (void)cublasLtMatrixLayoutDestroy(plan.c);
      (void)cublasLtMatmulDescDestroy(plan.operation);
    }
    (void)cublasLtDestroy(handle);
  }

  // cuBLASLt's matrices are column by column, so that ours are their transposes: Cᵀ = Bᵀ Aᵀ.
  template <typename T>
  const Plan& PlanOf(const MatmulArgs<T>& args, cudaDataType_t type) {
    const bool to_float = args.c_float != nullptr;
    const Key key{int(type),  to_float,          args.m,           args.n, args.k, args.a_row, args.b_row,
                  args.c_row, args.a_transposed, args.b_transposed};
    const auto found = plans.find(key);
    if (found != plans.end()) return found->second;
    Plan plan;
    Check(cublasLtMatmulDescCreate(&plan.operation, CUBLAS_COMPUTE_32F, CUDA_R_32F), "describing a product");
    const cublasOperation_t of_b = args.b_transposed ? CUBLAS_OP_T : CUBLAS_OP_N;
    const cublasOperation_t of_a = args.a_transposed ? CUBLAS_OP_T : CUBLAS_OP_N;
    Check(cublasLtMatmulDescSetAttribute(plan.operation, CUBLASLT_MATMUL_DESC_TRANSA, &of_b, sizeof(of_b)),
          "describing a product");
    Check(cublasLtMatmulDescSetAttribute(plan.operation, CUBLASLT_MATMUL_DESC_TRANSB, &of_a, sizeof(of_a)),
          "describing a product");
    const auto layout = [](cudaDataType_t of, int64_t rows, int64_t columns, int64_t leading) {
      cublasLtMatrixLayout_t made = nullptr;
      Check(cublasLtMatrixLayoutCreate(&made, of, uint64_t(rows), uint64_t(columns), leading), "describing a matrix");
      return made;
    };
    plan.b = layout(type, args.b_transposed ? args.k : args.n, args.b_transposed ? args.n : args.k, args.b_row);
    plan.a = layout(type, args.a_transposed ? args.m : args.k, args.a_transposed ? args.k : args.m, args.a_row);
    plan.c = layout(to_float ? CUDA_R_32F : type, args.n, args.m, args.c_row);
    cublasLtMatmulPreference_t preference = nullptr;
    Check(cublasLtMatmulPreferenceCreate(&preference), "choosing an algorithm");
    const size_t workspace_bytes = kWorkspaceBytes;
    Check(cublasLtMatmulPreferenceSetAttribute(preference, CUBLASLT_MATMUL_PREF_MAX_WORKSPACE_BYTES, &workspace_bytes,
                                               sizeof(workspace_bytes)),
          "choosing an algorithm");
    cublasLtMatmulHeuristicResult_t result{};
    int n_found = 0;
    const cublasStatus_t status = cublasLtMatmulAlgoGetHeuristic(handle, plan.operation, plan.b, plan.a, plan.c, plan.c,
                                                                 preference, 1, &result, &n_found);
    (void)cublasLtMatmulPreferenceDestroy(preference);
    Check(status, "choosing an algorithm");
    if (n_found == 0) throw DeviceError("cuBLASLt has no algorithm for a product");
    plan.algorithm = result.algo;
    return plans.emplace(key, plan).first->second;
  }

  template <typename T>
  void Multiply(const MatmulArgs<T>& args, cudaDataType_t type) {
    const Plan& plan = PlanOf(args, type);
    const ProfileScope scope("products", stream);
    const float one = 1, zero = 0;
    void* c = args.c_float != nullptr ? static_cast<void*>(args.c_float) : static_cast<void*>(args.c);
    Check(cublasLtMatmul(handle, plan.operation, &one, args.b, plan.b, args.a, plan.a, &zero, c, plan.c, c, plan.c,
                         &plan.algorithm, workspace.data(), kWorkspaceBytes, stream),
          "multiplying matrices");
  }

  static constexpr size_t kWorkspaceBytes = size_t{32} << 20;
  CudaStream stream;
  cublasLtHandle_t handle = nullptr;
  Buffer<char> workspace;
  std::map<Key, Plan> plans;
};

size_t Matmul::WorkspaceBytes() { return State::kWorkspaceBytes; }
Matmul::Matmul(CudaStream stream) : state_(std::make_unique<State>(stream)) {}
Matmul::~Matmul() = default;
void Matmul::operator()(const MatmulArgs<float>& args) const { state_->Multiply(args, CUDA_R_32F); }
void Matmul::operator()(const MatmulArgs<Bf16>& args) const { state_->Multiply(args, CUDA_R_16BF); }

struct Graph::State {
  cudaGraphExec_t graph = nullptr;
  ~State() { (void)cudaGraphExecDestroy(graph); }
};
Graph::Graph() = default;
Graph::~Graph() = default;
Graph::Graph(Graph&&) noexcept = default;
Graph& Graph::operator=(Graph&&) noexcept = default;

void Graph::Capture(CudaStream stream, const std::function<void()>& queue) {
  Check(cudaStreamBeginCapture(stream, cudaStreamCaptureModeThreadLocal), "capturing a graph");
  cudaGraph_t graph = nullptr;
  try {
    queue();
  } catch (...) {
    (void)cudaStreamEndCapture(stream, &graph);
    if (graph != nullptr) (void)cudaGraphDestroy(graph);
    (void)cudaGetLastError();
    throw;
  }
  Check(cudaStreamEndCapture(stream, &graph), "capturing a graph");
  auto state = std::make_unique<State>();
  const cudaError_t error = cudaGraphInstantiate(&state->graph, graph, 0);
  (void)cudaGraphDestroy(graph);
  Check(error, "making a graph ready");
  state_ = std::move(state);
}

void Graph::Launch(CudaStream stream) const { Check(cudaGraphLaunch(state_->graph, stream), "launching a graph"); }

void CheckLaunch(const char* what) { Check(cudaGetLastError(), what); }

}  // namespace nrff::device
