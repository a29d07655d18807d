// Gumbel noise, the drawn code of each token, its codebook row, and the soft probabilities.

// -log(-log(u)); with 23 random bits and a half, u is exact in float and never 0 or 1.
template <class T>
CONTROLMM_INLINE Lanes<T> gumbel_of(const Lanes<std::uint32_t>& words) {
  std::uint32_t word[kLanes];
  T mantissa[kLanes];
  store(word, words);
  for (std::int64_t i = 0; i < kLanes; ++i) mantissa[i] = static_cast<T>(static_cast<std::int32_t>(word[i] >> 9));
  const Lanes<T> u = (load(mantissa) + broadcast(T(0.5))) * broadcast(T(0x1p-23));
  return zeros<T>() - log(zeros<T>() - log(u));
}

// Calls visit(first code, count, noise) for blocks of sixteen codes of one token.
template <class T, class F>
CONTROLMM_INLINE void for_each_noise_block(const GumbelArgs<T>& args, std::int64_t row, F visit) {
  const std::int64_t clip = args.source.first_clip + row / args.tokens, token = row % args.tokens;
  const std::int64_t groups = (args.codes + 4 * kLanes - 1) / (4 * kLanes);
  Words next = random_words(args.source.seed, 0, token, clip);
  for (std::int64_t group = 0; group < groups; ++group) {
    const Words words = next;
    // Early, because its long chain of products can run beside the logarithms of this group.
    if (group + 1 < groups) next = random_words(args.source.seed, group + 1, token, clip);
    for (int w = 0; w < 4; ++w) {
      const std::int64_t first = (4 * group + w) * kLanes;
      if (first >= args.codes) return;
      visit(first, lanes_left(args.codes, first), gumbel_of<T>(words.w[w]));
    }
  }
}

template <class T>
struct Best {
  Lanes<T> value, block;  // largest value a lane has met, and in which block (small integers, exact)
};

template <class T>
CONTROLMM_INLINE std::int64_t index_of_best(const Best<T>& best, T& largest) {
  T value[kLanes], block[kLanes];
  store(value, best.value);
  store(block, best.block);
  std::int64_t index = static_cast<std::int64_t>(block[0]) * kLanes;
  largest = value[0];
  for (std::int64_t i = 1; i < kLanes; ++i) {
    const std::int64_t candidate = static_cast<std::int64_t>(block[i]) * kLanes + i;
    const bool wins = value[i] > largest || (value[i] == largest && candidate < index);
    if (!wins) continue;
    largest = value[i];
    index = candidate;
  }
  return index;
}

// Disturbed logits go to `row_out` unless it is null; returns the index of the largest, the first one on ties.
template <class T>
CONTROLMM_INLINE std::int64_t draw_code(const GumbelArgs<T>& args, std::int64_t row, T* row_out, T& largest) {
  const T* logits = args.logits + row / args.tokens * args.clip_stride + row % args.tokens * args.token_stride;
  const T lowest = -static_cast<T>(__builtin_inf());
  Best<T> best = {broadcast(lowest), zeros<T>()};
  for_each_noise_block(args, row, [&](std::int64_t first, std::int64_t count, const Lanes<T>& noise) {
    Lanes<T> z = load_strided(logits + first, 1, count) + noise;
    if (count < kLanes) z = select(first_lanes<T>(count), z, broadcast(lowest));
    if (row_out != nullptr) store_strided(row_out + first, 1, count, z);
    const Mask<T> wins = z > best.value;
    best.value = select(wins, z, best.value);
    best.block = select(wins, broadcast(static_cast<T>(first / kLanes)), best.block);
  });
  return index_of_best(best, largest);
}

// Softmax of z / temperature in place. Subtracting the largest first keeps any temperature free of overflow.
template <class T>
CONTROLMM_INLINE void softmax_row(T* z, std::int64_t codes, T largest, T temperature) {
  const Lanes<T> top = broadcast(largest), inverse = broadcast(T{1} / temperature);
  Lanes<T> total = zeros<T>();
  for (std::int64_t k = 0; k < codes; k += kLanes) {
    const std::int64_t count = lanes_left(codes, k);
    Lanes<T> e = exp_of_nonpositive((load_strided(z + k, 1, count) - top) * inverse);
    if (count < kLanes) e = select(first_lanes<T>(count), e, zeros<T>());
    store_strided(z + k, 1, count, e);
    total = total + e;
  }
  const Lanes<T> share = broadcast(T{1} / sum(total));
  for (std::int64_t k = 0; k < codes; k += kLanes) {
    const std::int64_t count = lanes_left(codes, k);
    store_strided(z + k, 1, count, load_strided(z + k, 1, count) * share);
  }
}

template <class T>
void gumbel(const GumbelArgs<T>& args, ClipRange rows) {
  for (std::int64_t row = rows.begin; row < rows.end; ++row) {
    T* probabilities = args.probabilities == nullptr ? nullptr : args.probabilities + row * args.codes;
    if (args.logits == nullptr) {
      for_each_noise_block(args, row, [&](std::int64_t first, std::int64_t count, const Lanes<T>& noise) {
        store_strided(probabilities + first, 1, count, noise);
      });
      continue;
    }
    T largest;
    const std::int64_t code = draw_code(args, row, probabilities, largest);
    args.ids[row] = code;
    if (args.channels != 0)
      __builtin_memcpy(args.embeddings + row * args.channels, args.codebook + code * args.channels,
                       static_cast<std::size_t>(args.channels) * sizeof(T));
    if (probabilities != nullptr) softmax_row(probabilities, args.codes, largest, args.temperature);
  }
}

template <class T>
void softmax_backward(const SoftmaxArgs<T>& args, ClipRange rows) {
  for (std::int64_t row = rows.begin; row < rows.end; ++row) {
    const T* p = args.probabilities + row * args.codes;
    T* g = args.gradient + row * args.codes;
    Lanes<T> products = zeros<T>();
    for (std::int64_t k = 0; k < args.codes; k += kLanes) {
      const std::int64_t count = lanes_left(args.codes, k);
      const Lanes<T> product = load_strided(p + k, 1, count) * load_strided(g + k, 1, count);
      products = products + (count < kLanes ? select(first_lanes<T>(count), product, zeros<T>()) : product);
    }
    const Lanes<T> mean = broadcast(sum(products)), scale = broadcast(args.inverse_temperature);
    for (std::int64_t k = 0; k < args.codes; k += kLanes) {
      const std::int64_t count = lanes_left(args.codes, k);
      const Lanes<T> centred = load_strided(g + k, 1, count) - mean;
      store_strided(g + k, 1, count, load_strided(p + k, 1, count) * centred * scale);
    }
  }
}
