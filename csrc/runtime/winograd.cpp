#include <vector>

#include "checks.h"

namespace controlmm {
namespace {

// Frames of tiles: each in the clip, or -1.
const std::int64_t* checked_rows(const TensorView& rows, std::int64_t each, std::int64_t frames) {
  checks::require(rows, "rows", 2, DType::int64);
  checks::require_shape(rows, "rows", {rows.shape[0], each});
  checks::require_contiguous(rows, "rows");
  const std::int64_t* first = rows.as<const std::int64_t>();
  for (std::int64_t i = 0; i < rows.size(); ++i)
    if (first[i] < -1 || first[i] >= frames)
      throw std::invalid_argument("`rows` must lie within [-1, " + std::to_string(frames) + "), got " +
                                  std::to_string(first[i]) + ".");
  return first;
}

void require_every_frame_once(const std::int64_t* rows, std::int64_t count, std::int64_t frames) {
  std::vector<bool> is_made(static_cast<std::size_t>(frames));
  std::int64_t made = 0;
  for (std::int64_t i = 0; i < count; ++i) {
    if (rows[i] < 0) continue;
    if (is_made[static_cast<std::size_t>(rows[i])])
      throw std::invalid_argument("`rows` must name every frame once, got " + std::to_string(rows[i]) + " twice.");
    is_made[static_cast<std::size_t>(rows[i])] = true;
    ++made;
  }
  if (made != frames)
    throw std::invalid_argument("`rows` must name every frame once, got " + std::to_string(made) + " of " +
                                std::to_string(frames) + ".");
}

}  // namespace

void winograd_parts(const TensorView& x, const TensorView& rows, const TensorView& parts) {
  checks::for_dtype(x, "x", [&](auto zero) {
    using T = decltype(zero);
    checks::require(x, "x", 2, x.dtype);
    checks::require_contiguous(x, "x");
    const std::int64_t* frames = checked_rows(rows, 6, x.shape[0]);
    checks::require(parts, "parts", 3, x.dtype);
    checks::require_shape(parts, "parts", {6, rows.shape[0], x.shape[1]});
    checks::require_row_major(parts, "parts");
    if (parts.size() == 0) return;
    const std::vector<T> zeros(static_cast<std::size_t>(x.shape[1]));
    active_kernels().of<T>().winograd_parts(
        {rows.shape[0], x.shape[1], frames, x.as<const T>(), zeros.data(), parts.as<T>()});
  });
}

void winograd_frames(const TensorView& products, const TensorView& rows, const TensorView& bias, bool is_rectified,
                     const TensorView& y) {
  checks::for_dtype(y, "y", [&](auto zero) {
    using T = decltype(zero);
    checks::require(y, "y", 2, y.dtype);
    checks::require_row_major(y, "y");
    WinogradFramesArgs<T> args{};
    args.rows = checked_rows(rows, 4, y.shape[0]);
    args.tiles = rows.shape[0];
    args.channels = y.shape[1];
    require_every_frame_once(args.rows, rows.size(), y.shape[0]);
    checks::require(products, "products", 3, y.dtype);
    checks::require_shape(products, "products", {6, args.tiles, args.channels});
    checks::require_contiguous(products, "products");
    args.products = products.as<const T>();
    checks::require(bias, "bias", 1, y.dtype);
    if (bias.size() != 0) checks::require_shape(bias, "bias", {args.channels});
    checks::require_contiguous(bias, "bias");
    if (y.size() == 0) return;
    // Behind one another: what nobody wants, and zeros in place of a bias.
    std::vector<T> spare(2 * static_cast<std::size_t>(args.channels));
    args.discarded = spare.data();
    args.bias = bias.size() == 0 ? spare.data() + args.channels : bias.as<const T>();
    args.is_rectified = is_rectified;
    args.y = y.as<T>();
    active_kernels().of<T>().winograd_frames(args);
  });
}

}  // namespace controlmm
