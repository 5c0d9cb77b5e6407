// What the CPU kernels share: wider vectors where the processor has them. NRFF_INLINE functions are the GPU's, too.
//
// A function marked NRFF_MULTIVERSION is compiled for plain x86-64, for AVX2 and for AVX-512; the dynamic loader picks
// one. Everything it calls must be NRFF_INLINE to be compiled along with it. Sanitizer builds keep the plain version:
// their run time is not up yet when the loader picks.
#pragma once

#if defined(__CUDACC__)
#define NRFF_INLINE __host__ __device__ __forceinline__
#else
#define NRFF_INLINE inline __attribute__((always_inline))
#endif
#define NRFF_LAMBDA_INLINE __attribute__((always_inline))

// Where blocking depends on the width of vectors, functions are compiled per level by hand instead: NRFF_CPU_LEVELS says
// that __builtin_cpu_supports and target attributes can be used.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define NRFF_CPU_LEVELS
#endif

#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && !defined(__SANITIZE_ADDRESS__)
#define NRFF_MULTIVERSION __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define NRFF_MULTIVERSION
#endif
