// Compiled once for each instruction set. Everything is in an unnamed namespace, so that no function built with
// newer instructions can be the copy the linker keeps for older processors.
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <type_traits>
#include <utility>

#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#include "kernel_table.h"

#define CONTROLMM_TEXT_OF(name) #name
#define CONTROLMM_TEXT(name) CONTROLMM_TEXT_OF(name)

namespace controlmm {
namespace CONTROLMM_ISA {
namespace {

// In this order: each file is written in terms of those above it.
// clang-format off
#include "simd.inl"
#include "mask.inl"
#include "strided.inl"
#include "heading.inl"
#include "recover_joints.inl"
#include "consistency.inl"
#include "obstacles.inl"
#include "controlled_joints.inl"
#include "guidance.inl"
#include "philox.inl"
#include "exponential.inl"
#include "gumbel.inl"
#include "banded.inl"
#include "projection.inl"
#include "clip_system.inl"
#include "smooth_bones.inl"
#include "frame_bones.inl"
#include "swing.inl"
#include "winograd.inl"
// clang-format on

template <class T>
constexpr Kernels<T> kernels() {
  return {&recover_joints<T>, &recover_joints_backward<T>, &consistency<T>,    &consistency_backward<T>,
          &obstacle_loss<T>,  &obstacle_loss_backward<T>,  &gumbel<T>,         &softmax_backward<T>,
          &guidance<T>,       &winograd_parts<T>,          &winograd_frames<T>};
}

}  // namespace

extern const KernelTable table;
const KernelTable table = {CONTROLMM_TEXT(CONTROLMM_ISA),
                           kernels<float>(),
                           kernels<double>(),
                           {&project, &smooth_bones, &frame_bones, &swing_rotations}};

}  // namespace CONTROLMM_ISA
}  // namespace controlmm
