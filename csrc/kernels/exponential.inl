// Logarithm and exponential of sixteen values, with the same bits on every instruction set.

template <class T>
struct FloatFormat;
template <>
struct FloatFormat<float> {
  static constexpr int kMantissaBits = 23, kBias = 127, kLogTerms = 5, kExpTerms = 7;
  static constexpr std::int32_t kRootHalf = 0x3f3504f3;  // bits of sqrt(1/2)
  static constexpr float kLn2High = 0x1.62e4p-1f, kLn2Low = 0x1.7f7d1cp-20f, kSmallestExponent = -87.0f;
  static constexpr float kRound = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
};
template <>
struct FloatFormat<double> {
  static constexpr int kMantissaBits = 52, kBias = 1023, kLogTerms = 11, kExpTerms = 14;
  static constexpr std::int64_t kRootHalf = 0x3fe6a09e667f3bcd;
  static constexpr double kLn2High = 0x1.62e42fefa38p-1, kLn2Low = 0x1.ef35793c7673p-45, kSmallestExponent = -708.0;
  static constexpr double kRound = 6755399441055744.0;
};

// 1 / (2 i + 1) and 1 / i!, the coefficients of the two series.
constexpr double kInverseOdd[] = {1.0,      1.0 / 3,  1.0 / 5,  1.0 / 7,  1.0 / 9, 1.0 / 11,
                                  1.0 / 13, 1.0 / 15, 1.0 / 17, 1.0 / 19, 1.0 / 21};
constexpr double kInverseFactorial[] = {1.0,
                                        1.0,
                                        1.0 / 2,
                                        1.0 / 6,
                                        1.0 / 24,
                                        1.0 / 120,
                                        1.0 / 720,
                                        1.0 / 5040,
                                        1.0 / 40320,
                                        1.0 / 362880,
                                        1.0 / 3628800,
                                        1.0 / 39916800,
                                        1.0 / 479001600,
                                        1.0 / 6227020800.0,
                                        1.0 / 87178291200.0};

// Natural logarithm of positive normal numbers: x = m 2^e with m in [sqrt(1/2), sqrt(2)),
// log m = 2 artanh((m - 1) / (m + 1)) as a series.
template <class T>
CONTROLMM_INLINE Lanes<T> log(const Lanes<T>& x) {
  using F = FloatFormat<T>;
  using Int = typename IntOf<T>::type;
  const Lanes<Int> bits = bits_of<Int>(x), above = bits - broadcast(Int{F::kRootHalf});
  const Lanes<Int> exponent = above >> broadcast(Int{F::kMantissaBits});
  const Lanes<Int> shift = exponent * broadcast(Int{1} << F::kMantissaBits);
  const Lanes<T> m = bits_of<T>(bits - shift), one = broadcast(T{1});
  const Lanes<T> s = (m - one) / (m + one), s2 = s * s;
  Lanes<T> series = broadcast(static_cast<T>(kInverseOdd[F::kLogTerms - 1]));
  for (int i = F::kLogTerms - 2; i >= 0; --i) series = series * s2 + broadcast(static_cast<T>(kInverseOdd[i]));
  const Lanes<T> e = converted<T>(exponent);
  return e * broadcast(F::kLn2High) + (e * broadcast(F::kLn2Low) + (s + s) * series);
}

// Exponential of numbers up to 0; what would be subnormal becomes 0.
template <class T>
CONTROLMM_INLINE Lanes<T> exp_of_nonpositive(const Lanes<T>& x) {
  using F = FloatFormat<T>;
  using Int = typename IntOf<T>::type;
  using Word = std::make_unsigned_t<Int>;  // a NaN's exponent is no number, and may wrap around
  const Lanes<T> lowest = broadcast(F::kSmallestExponent), clamped = select(x < lowest, lowest, x);
  const Lanes<T> shifted = clamped * broadcast(T(1.4426950408889634)) + broadcast(F::kRound);
  const Lanes<T> n = shifted - broadcast(F::kRound);
  const Lanes<T> r = (clamped - n * broadcast(F::kLn2High)) - n * broadcast(F::kLn2Low);
  Lanes<T> series = broadcast(static_cast<T>(kInverseFactorial[F::kExpTerms]));
  for (int i = F::kExpTerms - 1; i >= 0; --i) series = series * r + broadcast(static_cast<T>(kInverseFactorial[i]));
  const Lanes<Int> exponent = bits_of<Int>(shifted) - bits_of<Int>(broadcast(F::kRound));
  const Lanes<Word> biased = bits_of<Word>(exponent) + broadcast(Word{F::kBias});
  const Lanes<T> power = bits_of<T>(biased * broadcast(Word{1} << F::kMantissaBits));
  return select(x < lowest, zeros<T>(), series * power);
}
