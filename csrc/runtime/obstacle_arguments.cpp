#include "obstacle_arguments.h"

namespace controlmm {
namespace {

void check_height_field(const std::int64_t* kind, std::int64_t samples) {
  const std::int64_t first = kind[1], rows = kind[2], columns = kind[3];
  const bool fits = first >= 0 && rows >= 2 && columns >= 2 && rows <= samples && columns <= samples &&
                    rows * columns <= samples - first;
  if (!fits)
    throw std::invalid_argument("`heights` must hold the " + std::to_string(rows) + " x " + std::to_string(columns) +
                                " samples (at least 2 x 2) of a height field from index " + std::to_string(first) +
                                ", got " + std::to_string(samples) + " samples.");
}

void check_kinds(const TensorView& kinds, std::int64_t samples) {
  for (std::int64_t o = 0; o < kinds.shape[0]; ++o) {
    const std::int64_t* kind = kinds.as<const std::int64_t>() + 4 * o;
    if (kind[0] < 0 || kind[0] > static_cast<std::int64_t>(ObstacleKind::height_field))
      throw std::invalid_argument("`kinds` must hold obstacle kinds 0 to 5, got " + std::to_string(kind[0]) + ".");
    if (kind[0] == static_cast<std::int64_t>(ObstacleKind::height_field)) check_height_field(kind, samples);
  }
}

void require_broadcast(std::int64_t extent, std::int64_t expected, const TensorView& parameters) {
  if (extent != expected && extent != 1)
    throw std::invalid_argument("`parameters` must have batch and frames of the joints or 1, got shape " +
                                checks::shape_text(parameters) + ".");
}

void check_lengths(const TensorView& lengths, std::int64_t frames) {
  for (std::int64_t clip = 0; clip < lengths.shape[0]; ++clip) {
    const std::int64_t length = lengths.as<const std::int64_t>()[clip];
    if (length < 0 || length > frames)
      throw std::invalid_argument("`lengths` must lie between 0 and the " + std::to_string(frames) + " frames, got " +
                                  std::to_string(length) + " for clip " + std::to_string(clip) + ".");
  }
}

}  // namespace

template <class T>
ObstacleArgs<T> checked_obstacles(const Obstacles& obstacles, const Clearance& clearance, std::int64_t clips,
                                  const MotionShape& shape) {
  constexpr DType dtype = detail::DTypeOf<T>::value;
  const TensorView &kinds = obstacles.kinds, &parameters = obstacles.parameters;
  checks::require(kinds, "kinds", 2, DType::int64);
  checks::require_shape(kinds, "kinds", {kinds.shape[0], 4});
  checks::require_contiguous(kinds, "kinds");
  checks::require(parameters, "parameters", 4, dtype);
  checks::require_shape(parameters, "parameters",
                        {parameters.shape[0], kinds.shape[0], kObstacleParameters, parameters.shape[3]});
  require_broadcast(parameters.shape[0], clips, parameters);
  require_broadcast(parameters.shape[3], shape.frames, parameters);
  checks::require(obstacles.heights, "heights", 1, dtype);
  checks::require_contiguous(obstacles.heights, "heights");
  check_kinds(kinds, obstacles.heights.shape[0]);
  checks::require(clearance.radii, "radii", 1, dtype);
  checks::require_shape(clearance.radii, "radii", {shape.joints});
  checks::require_contiguous(clearance.radii, "radii");
  checks::require(clearance.is_active, "is_active", 1, DType::boolean);
  checks::require_shape(clearance.is_active, "is_active", {shape.joints});
  checks::require_contiguous(clearance.is_active, "is_active");
  checks::require(clearance.lengths, "lengths", 1, DType::int64);
  checks::require_shape(clearance.lengths, "lengths", {clips});
  checks::require_contiguous(clearance.lengths, "lengths");
  check_lengths(clearance.lengths, shape.frames);
  return {kinds.shape[0],
          kinds.as<const std::int64_t>(),
          checks::broadcast4<const T>(parameters, 0, 3, 1, 2),
          obstacles.heights.as<const T>(),
          clearance.radii.as<const T>(),
          clearance.is_active.as<const std::uint8_t>(),
          clearance.lengths.as<const std::int64_t>(),
          static_cast<T>(clearance.margin)};
}

template ObstacleArgs<float> checked_obstacles<float>(const Obstacles&, const Clearance&, std::int64_t,
                                                      const MotionShape&);
template ObstacleArgs<double> checked_obstacles<double>(const Obstacles&, const Clearance&, std::int64_t,
                                                        const MotionShape&);

}  // namespace controlmm
