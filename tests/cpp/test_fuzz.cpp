// Random shapes, strides, values and exact-size heap blocks: with AddressSanitizer any step outside shows.
#include <algorithm>
#include <limits>
#include <memory>
#include <random>
#include <stdexcept>
#include <vector>

#include "check.h"
#include "controlmm/dispatch.h"
#include "controlmm/kernels.h"

namespace {

using controlmm::TensorView;
std::mt19937_64 random_bits(20240607);

std::int64_t pick(std::int64_t low, std::int64_t high) {
  return low + static_cast<std::int64_t>(random_bits() % static_cast<std::uint64_t>(high - low + 1));
}

double pick_value() {
  switch (pick(0, 40)) {
    case 0:
      return std::numeric_limits<double>::quiet_NaN();
    case 1:
      return std::numeric_limits<double>::infinity();
    case 2:
      return -1e30;
    default:
      return static_cast<double>(pick(-1000, 1000)) * 1e-3;
  }
}

// Memory of exactly the reach of a view, so that nothing lies behind it.
template <class T>
struct Block {
  std::unique_ptr<T[]> data;
  TensorView view;
};

template <class T>
Block<T> row_major_block(const std::vector<std::int64_t>& shape) {
  Block<T> block;
  std::int64_t size = 1;
  block.view.ndim = static_cast<int>(shape.size());
  block.view.dtype = controlmm::detail::DTypeOf<T>::value;
  for (int i = block.view.ndim - 1; i >= 0; --i) {
    block.view.shape[i] = shape[static_cast<std::size_t>(i)];
    block.view.strides[i] = size;
    size *= block.view.shape[i];
  }
  block.data.reset(new T[static_cast<std::size_t>(size)]);
  block.view.data = block.data.get();
  for (std::int64_t i = 0; i < size; ++i) block.data[static_cast<std::size_t>(i)] = static_cast<T>(pick_value());
  return block;
}

template <>
Block<bool> row_major_block<bool>(const std::vector<std::int64_t>& shape) {
  Block<bool> block;
  std::int64_t size = 1;
  block.view.ndim = static_cast<int>(shape.size());
  block.view.dtype = controlmm::DType::boolean;
  for (int i = block.view.ndim - 1; i >= 0; --i) {
    block.view.shape[i] = shape[static_cast<std::size_t>(i)];
    block.view.strides[i] = size;
    size *= block.view.shape[i];
  }
  block.data.reset(new bool[static_cast<std::size_t>(size)]);
  block.view.data = block.data.get();
  for (std::int64_t i = 0; i < size; ++i) block.data[static_cast<std::size_t>(i)] = pick(0, 3) == 0;
  return block;
}

// The same memory seen through permuted axes or with some of them repeated.
template <class T>
Block<T> input_block(std::vector<std::int64_t> shape) {
  std::vector<std::size_t> order(shape.size());
  for (std::size_t i = 0; i < order.size(); ++i) order[i] = i;
  std::shuffle(order.begin(), order.end(), random_bits);
  std::vector<std::int64_t> stored(shape.size());
  for (std::size_t i = 0; i < order.size(); ++i) stored[i] = pick(0, 9) == 0 ? 1 : shape[order[i]];
  Block<T> block = row_major_block<T>(stored);
  TensorView view = block.view;
  for (std::size_t i = 0; i < order.size(); ++i) {
    view.shape[order[i]] = shape[order[i]];
    view.strides[order[i]] = stored[i] == shape[order[i]] ? block.view.strides[i] : 0;
  }
  block.view = view;
  return block;
}

struct Sizes {
  std::int64_t clips = pick(0, 3), frames = pick(0, 40), joints = pick(1, 24), extra = pick(0, 30);
  std::int64_t dim() const { return 4 + 3 * (joints - 1) + extra; }
};

template <class T>
void fuzz_kinematics() {
  const Sizes n;
  const auto features = input_block<T>({n.clips, n.frames, n.dim()});
  const auto joints = row_major_block<T>({n.clips, n.frames, n.joints, 3});
  const auto cotangent = input_block<T>({n.clips, n.frames, n.joints, 3});
  const auto gradient = row_major_block<T>({n.clips, n.frames, n.dim()});
  controlmm::recover_joints(features.view, joints.view, 2);
  controlmm::recover_joints_backward(features.view, cotangent.view, gradient.view, 2);
}

template <class T>
struct FuzzScene {
  explicit FuzzScene(const Sizes& n)
      : kinds(row_major_block<std::int64_t>({count, 4})),
        parameters(input_block<T>({n.clips, count, controlmm::kObstacleParameters, n.frames})),
        heights(row_major_block<T>({20})),
        radii(row_major_block<T>({n.joints})),
        is_active(row_major_block<bool>({n.joints})),
        lengths(row_major_block<std::int64_t>({n.clips})) {
    for (std::int64_t o = 0; o < count; ++o) {
      const std::int64_t kind[4] = {pick(0, 5), pick(0, 4), pick(2, 4), pick(2, 4)};
      for (std::int64_t i = 0; i < 4; ++i) kinds.data[static_cast<std::size_t>(4 * o + i)] = kind[i];
    }
    for (std::int64_t b = 0; b < n.clips; ++b) lengths.data[static_cast<std::size_t>(b)] = pick(0, n.frames);
  }
  controlmm::Obstacles obstacles() const { return {kinds.view, parameters.view, heights.view}; }
  controlmm::Clearance clearance() const { return {radii.view, is_active.view, lengths.view, 0.1, pick(0, 1) == 0}; }

  std::int64_t count = pick(0, 5);
  Block<std::int64_t> kinds;
  Block<T> parameters, heights, radii;
  Block<bool> is_active;
  Block<std::int64_t> lengths;
};

template <class T>
void fuzz_losses() {
  const Sizes n;
  const auto norm = static_cast<controlmm::Norm>(pick(0, 2));
  const std::vector<std::int64_t> shape = {n.clips, n.frames, n.joints, 3};
  const auto joints = input_block<T>(shape), targets = input_block<T>(shape);
  const auto mask = input_block<bool>(shape);
  const auto loss = row_major_block<T>({n.clips});
  const auto counts = row_major_block<double>({n.clips});
  const auto gradient = row_major_block<T>(shape);
  controlmm::masked_consistency_loss(joints.view, targets.view, mask.view, norm, loss.view, counts.view, 2);
  controlmm::masked_consistency_loss_backward(joints.view, targets.view, mask.view, norm, loss.view, counts.view,
                                              gradient.view, 2);
  const FuzzScene<T> scene(n);
  controlmm::obstacle_loss(joints.view, scene.obstacles(), scene.clearance(), loss.view, 2);
  controlmm::obstacle_loss_backward(joints.view, scene.obstacles(), scene.clearance(), loss.view, gradient.view, 2);
  const auto decoded = input_block<T>({n.clips, n.dim(), n.frames});
  const auto mean = row_major_block<T>({n.dim()}), std = row_major_block<T>({n.dim()});
  const auto out = row_major_block<T>({n.clips, n.dim(), n.frames});
  controlmm::guidance_value_and_grad(decoded.view, mean.view, std.view, targets.view, mask.view, norm,
                                     scene.obstacles(), scene.clearance(), 0.7, loss.view, out.view, 2);
}

template <class T>
void fuzz_gumbel() {
  const std::int64_t clips = pick(0, 3), tokens = pick(0, 9), codes = pick(1, 200), channels = pick(1, 9);
  const auto logits = row_major_block<T>({clips, tokens, codes}), codebook = row_major_block<T>({codes, channels});
  const auto ids = row_major_block<std::int64_t>({clips, tokens});
  const auto embeddings = row_major_block<T>({clips, tokens, channels});
  const auto probabilities = row_major_block<T>({clips, tokens, pick(0, 1) == 0 ? 0 : codes});
  controlmm::gumbel_straight_through(logits.view, codebook.view, 1e-8, {random_bits(), 3}, ids.view, embeddings.view,
                                     probabilities.view, 2);
  for (std::int64_t i = 0; i < clips * tokens; ++i) {
    CHECK(ids.data[static_cast<std::size_t>(i)] >= 0);
    CHECK(ids.data[static_cast<std::size_t>(i)] < codes);
  }
  const auto rows = row_major_block<T>({clips * tokens, codes}), gradient = row_major_block<T>({clips * tokens, codes});
  controlmm::softmax_backward(rows.view, 0.5, gradient.view, 2);
}

void fuzz_exact() {
  const std::int64_t frames = pick(0, 12), joints = pick(1, 24), steps = 2 * pick(0, 3);
  const auto parents = row_major_block<std::int64_t>({joints});
  for (std::int64_t j = 0; j < joints; ++j) parents.data[static_cast<std::size_t>(j)] = j == 0 ? -1 : pick(0, j - 1);
  const auto held = row_major_block<bool>({frames, joints, 3}), planted = row_major_block<bool>({frames, joints});
  const auto feet = row_major_block<bool>({joints}), toes = row_major_block<bool>({joints});
  const auto lengths = row_major_block<double>({joints}), start = row_major_block<double>({frames, joints, 3});
  const auto change = row_major_block<double>({frames, joints, 3}), clip = row_major_block<double>({frames, joints, 3});
  const controlmm::PoseWeights weights{10, 1e3, 100, 1e4, 1e5, 3e3, 1e3};
  controlmm::project_change(parents.view, held.view, planted.view, 10, 100, 1e4, change.view);
  controlmm::smooth_bones(parents.view, start.view, lengths.view, held.view, planted.view, feet.view, toes.view,
                          weights, 1e-3, steps, clip.view);
  const auto frame = row_major_block<double>({frames, joints, 3});
  controlmm::frame_bones(parents.view, lengths.view, held.view, planted.view, feet.view, weights, 1e-9, 1e-3, 0.05,
                         steps, frame.view);
  const auto starts = row_major_block<bool>({joints});
  const auto heading = row_major_block<double>({frames, 4}),
             rotations = row_major_block<double>({frames, joints - 1, 6});
  controlmm::swing_rotations(parents.view, starts.view, start.view, change.view, heading.view, rotations.view);
}

template <class T>
void fuzz_winograd() {
  const std::int64_t frames = pick(0, 30), inputs = pick(0, 40), outputs = pick(0, 40);
  const std::int64_t tiles = (frames + 3) / 4 + pick(0, 2);
  const auto taken = row_major_block<std::int64_t>({tiles, 6}), made = row_major_block<std::int64_t>({tiles, 4});
  for (std::int64_t i = 0; i < 6 * tiles; ++i) taken.data[static_cast<std::size_t>(i)] = pick(-1, frames - 1);
  std::vector<std::int64_t> places(static_cast<std::size_t>(4 * tiles));
  for (std::size_t i = 0; i < places.size(); ++i)
    places[i] = static_cast<std::int64_t>(i) < frames ? static_cast<std::int64_t>(i) : -1;
  std::shuffle(places.begin(), places.end(), random_bits);
  std::copy(places.begin(), places.end(), made.data.get());
  const auto x = row_major_block<T>({frames, inputs}), parts = row_major_block<T>({6, tiles, inputs});
  controlmm::winograd_parts(x.view, taken.view, parts.view);
  const auto products = row_major_block<T>({6, tiles, outputs}), y = row_major_block<T>({frames, outputs});
  const auto bias = row_major_block<T>({pick(0, 1) == 0 ? 0 : outputs});
  controlmm::winograd_frames(products.view, made.view, bias.view, pick(0, 1) == 0, y.view);
  if (frames == 0) return;
  made.data[0] = frames;
  bool is_refused = false;
  try {
    controlmm::winograd_frames(products.view, made.view, bias.view, false, y.view);
  } catch (const std::invalid_argument&) {
    is_refused = true;
  }
  CHECK(is_refused);
}

}  // namespace

int main() {
  for (const std::string& isa : controlmm::available_isas()) {
    controlmm::set_isa(isa);
    for (int round = 0; round < 150; ++round) {
      fuzz_kinematics<float>();
      fuzz_kinematics<double>();
      fuzz_losses<float>();
      fuzz_losses<double>();
      fuzz_winograd<float>();
      fuzz_winograd<double>();
      fuzz_gumbel<float>();
      fuzz_gumbel<double>();
      fuzz_exact();
    }
  }
}
