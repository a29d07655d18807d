// Which joints of a clip are controlled, found before any position is read.

// How much of a joint is masked. Where everything is, the mask need not be read again.
enum class Controlled : std::uint8_t { nowhere, somewhere, everywhere };

// Whether all of `n` booleans, or none of them, are set; words overlap at the end, which changes neither answer.
inline Controlled extent_of(const std::uint8_t* flags, std::int64_t n) {
  constexpr std::uint64_t kOnes = 0x0101010101010101u;
  std::uint64_t all = kOnes, any = 0;
  const auto take = [&](std::int64_t at) {
    std::uint64_t word;
    __builtin_memcpy(&word, flags + at, 8);
    all &= word;
    any |= word;
  };
  for (std::int64_t i = 0; i + 8 <= n; i += 8) take(i);
  if (n >= 8) take(n - 8);
  for (std::int64_t i = n < 8 ? 0 : n; i < n; ++i) {
    all &= kOnes * flags[i];
    any |= flags[i];
  }
  return any == 0 ? Controlled::nowhere : all == kOnes ? Controlled::everywhere : Controlled::somewhere;
}

struct MaskCount {
  std::int64_t joints, coords;  // frames with any coordinate masked, masked coordinates
};

inline MaskCount count_masked(const std::uint8_t* mask, std::int64_t frame, std::int64_t coord, std::int64_t frames) {
  MaskCount count = {0, 0};
  for (std::int64_t t = 0; t < frames; ++t) {
    const std::uint8_t* at = mask + t * frame;
    const int x = at[0] != 0, y = at[coord] != 0, z = at[2 * coord] != 0;
    count.joints += x | y | z;
    count.coords += x + y + z;
  }
  return count;
}

template <class T>
Controlled extent_of_joint(const GuidanceArgs<T>& args, const std::uint8_t* at) {
  const Strided4<const std::uint8_t>& m = args.mask;
  const std::int64_t frames = args.shape.frames;
  if (m.frame != 1) return Controlled::somewhere;
  if (m.coord == 0) return extent_of(at, frames);
  if (m.coord == frames) return extent_of(at, 3 * frames);
  return Controlled::somewhere;
}

template <class T>
std::int64_t find_controlled_joints(const GuidanceArgs<T>& args, std::int64_t clip, Controlled* controlled) {
  const Strided4<const std::uint8_t>& m = args.mask;
  const std::int64_t frames = args.shape.frames;
  MaskCount total = {0, 0};
  for (std::int64_t j = 0; j < args.shape.joints; ++j) {
    const std::uint8_t* at = m.data + clip * m.clip + j * m.joint;
    controlled[j] = extent_of_joint(args, at);
    if (controlled[j] == Controlled::nowhere) continue;
    const MaskCount count = controlled[j] == Controlled::everywhere ? MaskCount{frames, 3 * frames}
                                                                    : count_masked(at, m.frame, m.coord, frames);
    if (count.joints == 0) controlled[j] = Controlled::nowhere;
    total.joints += count.joints;
    total.coords += count.coords;
  }
  return args.norm == Norm::l2 ? total.joints : total.coords;
}
