// Symmetric positive definite systems of a clip's joints: bones tie joints of a frame, and every coordinate is tied to
// itself in the next frame. A frame alone is a tree of joints, whose elimination from the leaves on fills nothing;
// elimination in time would fill every frame. So frames are eliminated, and time is left to conjugate gradients, to
// fourteen digits: ties in time are weak beside what holds a frame by itself, the more so as every other frame is
// eliminated for good.
//
// The clip is cut into stretches that lie abreast, one a lane. So all frames go through the same steps, neighbours in
// time are neighbours in memory, and lanes meet only where one stretch ends and the next begins.

class ClipSystem {
 public:
  /// One frame's numbers, which lie `kAbreast` apart.
  struct Frame {
    double *blocks, *rights, *ties, *frees;

    double& block(std::int64_t j, int a, int b) const { return blocks[(kBlock * j + entry(a, b)) * kAbreast]; }
    double& direction(std::int64_t j, int a) const { return blocks[(kBlock * j + kDirection + a) * kAbreast]; }
    double& right(std::int64_t k) const { return rights[k * kAbreast]; }
    double& tie(std::int64_t k) const { return ties[k * kAbreast]; }
    double& is_free(std::int64_t k) const { return frees[k * kAbreast]; }
  };

  /// @param held   Coordinates that stay, row-major [frames, joints, 3].
  /// @param memory `banded_system_scratch(frames, joints)` doubles.
  ClipSystem(const BodyTree& body, const std::uint8_t* held, double stiffness, double bone_weight, double* memory)
      : body_(body),
        stiffness_(stiffness),
        bone_weight_(bone_weight),
        pairs_(clip_frame_pairs(body.frames)),
        row_(3 * body.joints * kAbreast),
        half_(pairs_ * row_) {
    constexpr std::uintptr_t kCacheLine = kAbreast * sizeof(double);  // a register in two of them costs twice
    blocks_ = memory + (kCacheLine - reinterpret_cast<std::uintptr_t>(memory) % kCacheLine) / sizeof(double);
    right_ = blocks_ + 6 * half_;
    ties_ = right_ + 2 * half_;
    free_ = ties_ + 2 * half_;
    left_ = free_ + 2 * half_;
    way_ = left_ + half_;
    image_ = way_ + half_;
    answer_ = image_ + half_;
    even_ = answer_ + half_;
    clear(free_, 2 * half_);  // lanes without a frame hold nothing that moves
    const std::int64_t width = 3 * body.joints;
    for (std::int64_t t = 0; t < body.frames; ++t)
      for (std::int64_t k = 0; k < width; ++k) frame(t).is_free(k) = held[t * width + k] ? 0 : 1;
  }

  /// Forgets all but what is held.
  void clear() { clear(blocks_, 10 * half_); }

  Frame frame(std::int64_t t) const {
    const std::int64_t stretch = 2 * pairs_, lane = t / stretch, step = t % stretch;
    const std::int64_t row = step % 2 * pairs_ + step / 2;  // even frames of all stretches come before odd ones
    const std::int64_t at = row * row_ + lane;
    return {blocks_ + 3 * row * row_ + lane, right_ + at, ties_ + at, free_ + at};
  }

  /// A bone from j to its parent: a spring along its direction, and one that all have in all directions.
  void add_bone(const Frame& frame, std::int64_t j, const double* direction) const {
    for (int a = 0; a < 3; ++a) {
      frame.direction(j, a) = direction[a];
      for (int b = 0; b <= a; ++b) {
        const double weight = bone_weight_ * direction[a] * direction[b] + (a == b ? stiffness_ : 0);
        frame.block(j, a, b) += weight;
        frame.block(body_.parents[j], a, b) += weight;
      }
    }
  }

  /// `weight` times the square by which a joint's coordinate changes from one frame to the next.
  static void add_tie(const Frame& here, const Frame& next, std::int64_t j, int c, double weight) {
    here.block(j, c, c) += weight;
    next.block(j, c, c) += weight;
    here.tie(3 * j + c) = weight * here.is_free(3 * j + c) * next.is_free(3 * j + c);
  }

  /// Leaves the solution in place of the right side: zero where coordinates are held. Uses up the matrix.
  void solve() {
    double *const even = right_, *const odd = right_ + half_;
    for (std::int64_t i = 0; i < 2 * half_; ++i) right_[i] *= free_[i];
    for (std::int64_t row = 0; row < 2 * pairs_; ++row) factorise(row);
    copy(even, even_);
    solve_even(even_);
    back_to_odd(odd, 1, left_);
    solve_odd_by_gradients(odd);
    on_to_even(odd);
    step(1, even_, even);
    solve_even(even);
  }

 private:
  using Reg = Lanes<double>::Reg;
  static constexpr std::int64_t kWidth = Lanes<double>::kWidth;
  static_assert(kAbreast % kWidth == 0, "whole registers");
  static constexpr int kDirection = 6, kBlock = 9;  // of a joint: half a symmetric block, then its bone's direction
  static constexpr double kExact = 1e-28;           // share of a residual's square: fourteen digits

  static constexpr int entry(int a, int b) { return a > b ? a * (a + 1) / 2 + b : b * (b + 1) / 2 + a; }

  // On what is left of the odd frames' right side, with the odd frames alone as the preconditioner.
  void solve_odd_by_gradients(double* x) {
    const std::int64_t most = 100 + half_;  // exact numbers would need no more than there are unknowns
    double enough = 0, before = 1;
    clear(x, half_);
    clear(way_, 2 * half_);  // and its image
    for (std::int64_t n = 0; n < most; ++n) {
      copy(left_, answer_);
      solve_odd(answer_);
      const double square = dot(left_, answer_);
      if (n == 0) enough = kExact * square;
      if (!(square > enough)) return;  // nor if one is no number
      // The odd frames' own part of the way's image goes on as the way does: there is nothing to multiply.
      follow(answer_, square / before, way_);
      follow(left_, square / before, image_);
      on_to_even(way_);
      solve_even(even_);
      back_to_odd(image_, -1, answer_);
      const double length = square / dot(way_, answer_);
      if (!(length > 0)) return;
      step(length, way_, x);
      step(-length, answer_, left_);
      before = square;
    }
  }

  // What ties make of odd frames in the even ones beside them. From `x` to `even_`.
  void on_to_even(const double* x) {
    const double* const odd_ties = ties_ + half_;
    for (std::int64_t i = 0; i < row_; i += kWidth) put(even_ + i, take(ties_ + i) * take(x + i));
    for (std::int64_t i = 0, last = half_ - row_; i < row_; ++i)
      if (i % kAbreast > 0) even_[i] += odd_ties[last + i - 1] * x[last + i - 1];
    for (std::int64_t i = row_, past = 0; i < half_; i += kWidth, past += kWidth)
      put(even_ + i, take(ties_ + i) * take(x + i) + take(odd_ties + past) * take(x + past));
  }
  // The other way, from `even_` to `odd`: `base`, and `sign` times what ties make.
  void back_to_odd(const double* base, double sign, double* odd) {
    const double* const odd_ties = ties_ + half_;
    double* const next = even_ + half_;  // the first even frames again, each for the stretch before its own
    for (std::int64_t i = 0; i < row_; ++i) next[i] = i % kAbreast + 1 < kAbreast ? even_[i + 1] : 0;
    for (std::int64_t i = 0; i < half_; i += kWidth) {
      const Reg made = take(ties_ + i) * take(even_ + i) + take(odd_ties + i) * take(even_ + i + row_);
      put(odd + i, take(base + i) + sign * made);
    }
  }

  struct Vector {
    Reg x, y, z;
  };
  // A joint's block, and its inverse after `factorise`.
  struct Block {
    Reg xx, xy, yy, xz, yz, zz;
  };
  static CONTROLMM_INLINE Block block(const double* p) {
    return {take(p),
            take(p + kAbreast),
            take(p + 2 * kAbreast),
            take(p + 3 * kAbreast),
            take(p + 4 * kAbreast),
            take(p + 5 * kAbreast)};
  }
  static CONTROLMM_INLINE Vector vector(const double* p) {
    return {take(p), take(p + kAbreast), take(p + 2 * kAbreast)};
  }
  static CONTROLMM_INLINE void put(double* p, const Vector& v) {
    put(p, v.x);
    put(p + kAbreast, v.y);
    put(p + 2 * kAbreast, v.z);
  }
  static CONTROLMM_INLINE void add(double* p, const Vector& v) {
    const Vector old = vector(p);
    put(p, Vector{old.x + v.x, old.y + v.y, old.z + v.z});
  }
  static CONTROLMM_INLINE Reg dot(const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
  static CONTROLMM_INLINE Vector times(const Block& m, const Vector& v) {
    return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
            m.xz * v.x + m.yz * v.y + m.zz * v.z};
  }
  // How a bone pulls at one end if the other moves.
  CONTROLMM_INLINE Vector pull(const Vector& direction, const Vector& v) const {
    const Reg along = bone_weight_ * dot(direction, v);
    return {stiffness_ * v.x + along * direction.x, stiffness_ * v.y + along * direction.y,
            stiffness_ * v.z + along * direction.z};
  }

  // Each joint's block becomes the inverse of what its children leave of it.
  void factorise(std::int64_t row) const {
    double* const blocks = blocks_ + 3 * row * row_;
    for (std::int64_t j = body_.joints - 1; j >= 0; --j)
      for (std::int64_t lane = 0; lane < kAbreast; lane += kWidth) {
        double* const own = blocks + kBlock * j * kAbreast + lane;
        const Block m = inverse(block(own), vector(free_ + row * row_ + 3 * j * kAbreast + lane));
        const Reg entries[6] = {m.xx, m.xy, m.yy, m.xz, m.yz, m.zz};
        for (int i = 0; i < kDirection; ++i) put(own + i * kAbreast, entries[i]);
        if (j > 0)
          relieve(blocks + kBlock * body_.parents[j] * kAbreast + lane, m, vector(own + kDirection * kAbreast));
      }
  }
  // By way of triangular factors. What is held gets rows and columns of zeros: it does not move and pulls at nothing.
  static CONTROLMM_INLINE Block inverse(const Block& m, const Vector& free) {
    const Reg xy = free.x * free.y * m.xy, xz = free.x * free.z * m.xz, yz = free.y * free.z * m.yz;
    const Reg x = 1.0 / (free.x * m.xx + (1.0 - free.x)), low_xy = xy * x, low_xz = xz * x;
    const Reg rest = yz - low_xz * xy;
    const Reg y = 1.0 / (free.y * m.yy + (1.0 - free.y) - low_xy * xy), low_yz = rest * y;
    const Reg z = 1.0 / (free.z * m.zz + (1.0 - free.z) - low_xz * xz - low_yz * rest);
    const Reg corner = low_xy * low_yz - low_xz;
    return {free.x * (x + low_xy * low_xy * y + corner * corner * z),
            -(low_xy * y) - low_yz * corner * z,
            free.y * (y + low_yz * low_yz * z),
            corner * z,
            -(low_yz * z),
            free.z * z};
  }
  // Takes from a parent's block what a child with this inverse and this bone no longer holds.
  CONTROLMM_INLINE void relieve(double* parent, const Block& m, const Vector& direction) const {
    const Vector moved = times(m, direction);
    const Reg d[3] = {direction.x, direction.y, direction.z}, v[3] = {moved.x, moved.y, moved.z};
    const Reg entries[6] = {m.xx, m.xy, m.yy, m.xz, m.yz, m.zz};
    const Reg along = bone_weight_ * bone_weight_ * dot(direction, moved);
    const double across = stiffness_ * bone_weight_, all = stiffness_ * stiffness_;
    for (int a = 0; a < 3; ++a)
      for (int b = 0; b <= a; ++b) {
        const Reg less = all * entries[entry(a, b)] + across * (d[a] * v[b] + v[a] * d[b]) + along * d[a] * d[b];
        double* const p = parent + entry(a, b) * kAbreast;
        put(p, take(p) - less);
      }
  }

  // Solves for frames alone, from the leaves to the root and back.
  void solve_even(double* x) const {
    for (std::int64_t row = 0; row < pairs_; ++row) solve_row(row, x + row * row_);
  }
  void solve_odd(double* x) const {
    for (std::int64_t row = 0; row < pairs_; ++row) solve_row(pairs_ + row, x + row * row_);
  }
  void solve_row(std::int64_t row, double* x) const {
    const double* const blocks = blocks_ + 3 * row * row_;
    for (std::int64_t j = body_.joints - 1; j >= 0; --j)
      for (std::int64_t lane = 0; lane < kAbreast; lane += kWidth) {
        const double* const p = blocks + kBlock * j * kAbreast + lane;
        double* const own = x + 3 * j * kAbreast + lane;
        const Vector answer = times(block(p), vector(own));
        put(own, answer);
        if (j > 0) add(x + 3 * body_.parents[j] * kAbreast + lane, pull(vector(p + kDirection * kAbreast), answer));
      }
    for (std::int64_t j = 1; j < body_.joints; ++j)
      for (std::int64_t lane = 0; lane < kAbreast; lane += kWidth) {
        const double* const p = blocks + kBlock * j * kAbreast + lane;
        const Vector parent = vector(x + 3 * body_.parents[j] * kAbreast + lane);
        add(x + 3 * j * kAbreast + lane, times(block(p), pull(vector(p + kDirection * kAbreast), parent)));
      }
  }

  // Numbers of every other frame.
  static void clear(double* to, std::int64_t n) {
    __builtin_memset(to, 0, static_cast<std::size_t>(n) * sizeof(double));
  }
  void copy(const double* from, double* to) const {
    __builtin_memcpy(to, from, static_cast<std::size_t>(half_) * sizeof(double));
  }
  void step(double length, const double* way, double* x) const {
    for (std::int64_t i = 0; i < half_; i += kWidth) put(x + i, take(x + i) + length * take(way + i));
  }
  void follow(const double* to, double turn, double* way) const {
    for (std::int64_t i = 0; i < half_; i += kWidth) put(way + i, take(to + i) + turn * take(way + i));
  }
  double dot(const double* a, const double* b) const {
    Lanes<double> total = zeros<double>();
    std::int64_t i = 0;
    for (; i + kLanes <= half_; i += kLanes) total = total + load(a + i) * load(b + i);
    double rest[kLanes] = {};
    for (std::int64_t k = 0; i + k < half_; ++k) rest[k] = a[i + k] * b[i + k];
    return sum(total + load(rest));
  }
  static CONTROLMM_INLINE Reg take(const double* p) {
    return *reinterpret_cast<const RegisterOf<double>::unaligned*>(p);
  }
  static CONTROLMM_INLINE void put(double* p, Reg value) {
    *reinterpret_cast<RegisterOf<double>::unaligned*>(p) = value;
  }

  const BodyTree& body_;
  double stiffness_, bone_weight_;
  std::int64_t pairs_, row_, half_;  // of frames in a stretch; doubles of frames abreast, and of every other frame
  double *blocks_, *right_, *ties_, *free_, *left_, *way_, *image_, *answer_, *even_;
};
