#pragma once

#include "checks.h"

namespace controlmm {

/// Checks obstacles and clearance against a batch of clips and makes them ready for the kernels.
/// @throws std::invalid_argument naming the argument that does not fit.
template <class T>
ObstacleArgs<T> checked_obstacles(const Obstacles& obstacles, const Clearance& clearance, std::int64_t clips,
                                  const MotionShape& shape);

extern template ObstacleArgs<float> checked_obstacles<float>(const Obstacles&, const Clearance&, std::int64_t,
                                                             const MotionShape&);
extern template ObstacleArgs<double> checked_obstacles<double>(const Obstacles&, const Clearance&, std::int64_t,
                                                               const MotionShape&);

/// What the sum of depths of one clip is multiplied with: 1, or 1 / (active joints x counted frames x obstacles).
template <class T>
double depth_scale(const ObstacleArgs<T>& args, const MotionShape& shape, std::int64_t clip, bool is_mean) {
  if (!is_mean) return 1;
  std::int64_t active = 0;
  for (std::int64_t j = 0; j < shape.joints; ++j) active += args.is_active[j] != 0;
  const std::int64_t terms = active * args.lengths[clip] * args.count;
  return terms == 0 ? 0 : 1 / static_cast<double>(terms);
}

/// Measured on one core: one joint against one obstacle in one frame.
constexpr double kNsPerCollision = 1.5;

template <class T>
double collision_ns(const ObstacleArgs<T>& args, const MotionShape& shape, std::int64_t clips) {
  return kNsPerCollision * static_cast<double>(args.count) * static_cast<double>(clips * shape.frames * shape.joints);
}

}  // namespace controlmm
