// Philox 4x32-10 (Salmon, Moraes, Dror, Shaw: Parallel random numbers: as easy as 1, 2, 3; SC 2011), sixteen
// counters at a time. Plain loops over 32 x 32 -> 64 bit products are left scalar by g++ 12.

using WordRegister = RegisterOf<std::uint32_t>::type;
using WideRegister = RegisterOf<std::uint64_t>::type;

struct Words {
  Lanes<std::uint32_t> w[4];
};

// Products of the low halves of 64-bit lanes.
CONTROLMM_INLINE WideRegister multiply_low_halves(WideRegister a, WideRegister b) {
#if defined(__AVX512F__)
  return reinterpret_cast<WideRegister>(
      _mm512_maskz_mul_epu32(0xFF, reinterpret_cast<__m512i>(a), reinterpret_cast<__m512i>(b)));
#elif defined(__AVX2__)
  return reinterpret_cast<WideRegister>(_mm256_mul_epu32(reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(b)));
#elif defined(__SSE2__)
  return reinterpret_cast<WideRegister>(_mm_mul_epu32(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b)));
#else
  return (a & 0xffffffffu) * (b & 0xffffffffu);
#endif
}

struct Product {
  WordRegister low, high;
};

CONTROLMM_INLINE Product multiply_words(WordRegister a, std::uint64_t factor) {
  const WideRegister wide = reinterpret_cast<WideRegister>(a), f = factor - WideRegister{};
  const WideRegister even = multiply_low_halves(wide, f), odd = multiply_low_halves(wide >> 32, f);
  constexpr std::uint64_t kLow = 0xffffffffu;
  return {reinterpret_cast<WordRegister>((even & kLow) | (odd << 32)),
          reinterpret_cast<WordRegister>((even >> 32) | (odd & ~kLow))};
}

template <int Part>
CONTROLMM_INLINE void philox_round(Words& c, std::uint32_t key0, std::uint32_t key1) {
  const Product p0 = multiply_words(c.w[0].part[Part], 0xD2511F53u);
  const Product p1 = multiply_words(c.w[2].part[Part], 0xCD9E8D57u);
  const WordRegister c1 = c.w[1].part[Part], c3 = c.w[3].part[Part];
  c.w[0].part[Part] = p1.high ^ c1 ^ key0;
  c.w[1].part[Part] = p1.low;
  c.w[2].part[Part] = p0.high ^ c3 ^ key1;
  c.w[3].part[Part] = p0.low;
}

template <std::size_t... Part>
CONTROLMM_INLINE void philox_round_parts(Words& c, std::uint32_t key0, std::uint32_t key1,
                                         std::index_sequence<Part...>) {
  (philox_round<static_cast<int>(Part)>(c, key0, key1), ...);
}

CONTROLMM_INLINE void philox(Words& counter, std::uint64_t key) {
  auto key0 = static_cast<std::uint32_t>(key), key1 = static_cast<std::uint32_t>(key >> 32);
  for (int round = 0; round < 10; ++round) {
    philox_round_parts(counter, key0, key1, Parts<std::uint32_t>{});
    key0 += 0x9E3779B9u;
    key1 += 0xBB67AE85u;
  }
}

// The random words of sixty-four neighbouring codes of one token: word w belongs to codes 16 w .. 16 w + 15.
CONTROLMM_INLINE Words random_words(std::uint64_t key, std::int64_t group, std::int64_t token, std::int64_t clip) {
  constexpr std::uint32_t kIndex[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  const Lanes<std::uint32_t> first = load(kIndex) + broadcast(static_cast<std::uint32_t>(group * kLanes));
  Words words = {{first, broadcast(static_cast<std::uint32_t>(token)), broadcast(static_cast<std::uint32_t>(clip)),
                  zeros<std::uint32_t>()}};
  philox(words, key);
  return words;
}
