// The part of the kinematics that runs along time: heading and root path as prefix sums, in double for any input
// type, because errors add up over a clip.

struct Heading {
  double *cos, *sin, *x, *z;  // one value a frame, padded to whole lanes
};

// value * scale + shift de-normalises; (1, 0) leaves it as it is.
struct RootChannels {
  double scale[3], shift[3];  // yaw velocity, velocity x, velocity z
};

constexpr RootChannels kDenormalised = {{1, 1, 1}, {0, 0, 0}};

// Sine and cosine of sixteen angles. Reduced by multiples of pi/2 in three parts, then Taylor series to x^15 and
// x^16: the remainder at pi/4 is below half a unit in the last place.
CONTROLMM_INLINE void sine_cosine(const Lanes<double>& angle, Lanes<double>& sine, Lanes<double>& cosine) {
  const auto all = [](double v) { return broadcast(v); };
  const Lanes<double> round_magic = all(6755399441055744.0);  // 1.5 * 2^52: adding it rounds to an integer
  const Lanes<double> shifted = angle * all(0.63661977236758134308) + round_magic;
  const Lanes<double> quarter = shifted - round_magic;
  const Lanes<double> r = ((angle - quarter * all(0x1.921fb544p+0)) - quarter * all(0x1.0b4611a6p-34)) -
                          quarter * all(0x1.3198a2e037073p-69);
  const Lanes<double> r2 = r * r;

  Lanes<double> s = all(-1.0 / 1307674368000.0);
  for (double c : {1.0 / 6227020800.0, -1.0 / 39916800.0, 1.0 / 362880.0, -1.0 / 5040.0, 1.0 / 120.0, -1.0 / 6.0})
    s = s * r2 + all(c);
  s = r + r * r2 * s;
  Lanes<double> c = all(1.0 / 20922789888000.0);
  for (double k :
       {-1.0 / 87178291200.0, 1.0 / 479001600.0, -1.0 / 3628800.0, 1.0 / 40320.0, -1.0 / 720.0, 1.0 / 24.0, -0.5})
    c = c * r2 + all(k);
  c = all(1.0) + r2 * c;

  // The low bits of the shifted value are the quadrant: the first swaps sine and cosine, the second is their sign.
  const Lanes<std::int64_t> bits = bits_of<std::int64_t>(shifted), one = broadcast(std::int64_t{1});
  const auto sign_from = [](const Lanes<std::int64_t>& low, std::int64_t bit) {
    return (low << broadcast(63 - bit)) & broadcast(std::numeric_limits<std::int64_t>::min());
  };
  const Mask<double> is_odd = bits_of<double>(bits_of<std::int64_t>(all(1)) | sign_from(bits, 0)) < all(0);
  sine = bits_of<double>(bits_of<std::int64_t>(select(is_odd, c, s)) ^ sign_from(bits, 1));
  cosine = bits_of<double>(bits_of<std::int64_t>(select(is_odd, s, c)) ^ sign_from(bits + one, 1));
}

// Past this the three-part reduction loses digits; such angles mean nothing but must stay right.
constexpr double kLargestReducedAngle = 1e5;

inline void fill_cos_sin(const double* yaw, std::int64_t padded, Heading out) {
  for (std::int64_t t = 0; t < padded; t += kLanes) {
    const Lanes<double> angle = load(yaw + t);
    Lanes<double> sine, cosine;
    sine_cosine(angle, sine, cosine);
    store(out.sin + t, sine);
    store(out.cos + t, cosine);
    if (!any(abs(angle) > broadcast(kLargestReducedAngle))) continue;
    for (std::int64_t i = t; i < t + kLanes; ++i) {
      const double original = yaw[i];
      if (!(__builtin_fabs(original) > kLargestReducedAngle)) continue;
      out.sin[i] = ::sin(original);
      out.cos[i] = ::cos(original);
    }
  }
}

template <class T>
void compute_heading(const T* features, std::int64_t frame_stride, std::int64_t channel_stride, std::int64_t frames,
                     const RootChannels& root, Heading out) {
  const std::int64_t padded = round_up_to_lanes(frames);
  double* yaw = out.x;  // free until the path is summed below
  double angle = 0;
  for (std::int64_t t = 0; t < frames; ++t) {
    yaw[t] = angle;
    angle += 2 * (static_cast<double>(features[t * frame_stride]) * root.scale[0] + root.shift[0]);
  }
  for (std::int64_t t = frames; t < padded; ++t) yaw[t] = 0;
  fill_cos_sin(yaw, padded, out);

  const T* velocity = features + channel_stride;
  double x = 0, z = 0;
  out.x[0] = out.z[0] = 0;
  for (std::int64_t t = 1; t < frames; ++t, velocity += frame_stride) {
    const double vx = static_cast<double>(velocity[0]) * root.scale[1] + root.shift[1];
    const double vz = static_cast<double>(velocity[channel_stride]) * root.scale[2] + root.shift[2];
    x += out.cos[t] * vx - out.sin[t] * vz;
    z += out.sin[t] * vx + out.cos[t] * vz;
    out.x[t] = x;
    out.z[t] = z;
  }
  for (std::int64_t t = frames; t < padded; ++t) out.x[t] = out.z[t] = 0;
}

// What the joints of each frame send to the root: the gradients of its x and z, and of its heading.
struct RootGradient {
  double *x, *z, *yaw;
};

// Suffix sums: the transpose of compute_heading. Writes channels 0, 1 and 2 of the gradient.
template <class T>
void heading_backward(const T* features, std::int64_t frame_stride, std::int64_t channel_stride, std::int64_t frames,
                      const RootChannels& root, Heading heading, RootGradient gradient, T* grad_features,
                      std::int64_t grad_frame_stride, std::int64_t grad_channel_stride) {
  double sum_x = 0, sum_z = 0, sum_yaw = 0;
  for (std::int64_t t = frames - 1; t >= 1; --t) {
    const T* velocity = features + (t - 1) * frame_stride + channel_stride;
    T* out = grad_features + (t - 1) * grad_frame_stride;
    const double vx = static_cast<double>(velocity[0]) * root.scale[1] + root.shift[1];
    const double vz = static_cast<double>(velocity[channel_stride]) * root.scale[2] + root.shift[2];
    sum_x += gradient.x[t];
    sum_z += gradient.z[t];
    const double local_x = heading.cos[t] * sum_x + heading.sin[t] * sum_z;
    const double local_z = heading.cos[t] * sum_z - heading.sin[t] * sum_x;
    sum_yaw += gradient.yaw[t] + (vx * local_z - vz * local_x);
    out[0] = static_cast<T>(2 * sum_yaw * root.scale[0]);
    out[grad_channel_stride] = static_cast<T>(local_x * root.scale[1]);
    out[2 * grad_channel_stride] = static_cast<T>(local_z * root.scale[2]);
  }
  T* last = grad_features + (frames - 1) * grad_frame_stride;
  for (std::int64_t c = 0; c < 3; ++c) last[c * grad_channel_stride] = 0;
}
