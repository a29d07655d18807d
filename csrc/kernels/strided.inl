// Lanes from memory with gaps, and runs shorter than sixteen. What lies past the last value is never touched.

#if defined(__AVX512F__)
CONTROLMM_INLINE RegisterOf<float>::type load_masked(const float* p, __mmask16 m) {
  return _mm512_maskz_loadu_ps(m, p);
}
CONTROLMM_INLINE RegisterOf<double>::type load_masked(const double* p, __mmask8 m) {
  return _mm512_maskz_loadu_pd(m, p);
}
CONTROLMM_INLINE void store_masked(float* p, __mmask16 m, RegisterOf<float>::type a) { _mm512_mask_storeu_ps(p, m, a); }
CONTROLMM_INLINE void store_masked(double* p, __mmask8 m, RegisterOf<double>::type a) {
  _mm512_mask_storeu_pd(p, m, a);
}
#elif defined(__AVX2__)
CONTROLMM_INLINE RegisterOf<float>::type load_masked(const float* p, RegisterOf<std::int32_t>::type m) {
  return _mm256_maskload_ps(p, reinterpret_cast<__m256i>(m));
}
CONTROLMM_INLINE RegisterOf<double>::type load_masked(const double* p, RegisterOf<std::int64_t>::type m) {
  return _mm256_maskload_pd(p, reinterpret_cast<__m256i>(m));
}
CONTROLMM_INLINE void store_masked(float* p, RegisterOf<std::int32_t>::type m, RegisterOf<float>::type a) {
  _mm256_maskstore_ps(p, reinterpret_cast<__m256i>(m), a);
}
CONTROLMM_INLINE void store_masked(double* p, RegisterOf<std::int64_t>::type m, RegisterOf<double>::type a) {
  _mm256_maskstore_pd(p, reinterpret_cast<__m256i>(m), a);
}
#endif

#if defined(__AVX2__)
template <class T, std::size_t... I>
CONTROLMM_INLINE Lanes<T> load_first_parts(const T* p, const Mask<T>& m, std::index_sequence<I...>) {
  return {{load_masked(p + I * static_cast<std::size_t>(Lanes<T>::kWidth), m.part[I])...}};
}
template <class T, std::size_t... I>
CONTROLMM_INLINE void store_first_parts(T* p, const Mask<T>& m, const Lanes<T>& a, std::index_sequence<I...>) {
  (store_masked(p + I * static_cast<std::size_t>(Lanes<T>::kWidth), m.part[I], a.part[I]), ...);
}
#endif

// How many of the sixteen lanes from `first` on are in use.
inline std::int64_t lanes_left(std::int64_t total, std::int64_t first) {
  return total - first < kLanes ? total - first : kLanes;
}

// The first `n` of sixteen neighbours; the other lanes are 0.
template <class T>
CONTROLMM_INLINE Lanes<T> load_first(const T* p, std::int64_t n) {
#if defined(__AVX2__)
  return load_first_parts(p, first_lanes<T>(n), Parts<T>{});
#else
  T buffer[kLanes] = {};
  for (std::int64_t i = 0; i < n; ++i) buffer[i] = p[i];
  return load(buffer);
#endif
}
template <class T>
CONTROLMM_INLINE void store_first(T* p, std::int64_t n, const Lanes<T>& a) {
#if defined(__AVX2__)
  store_first_parts(p, first_lanes<T>(n), a, Parts<T>{});
#else
  T buffer[kLanes];
  store(buffer, a);
  for (std::int64_t i = 0; i < n; ++i) p[i] = buffer[i];
#endif
}

// `n` lanes spaced by `stride`; the others are unspecified but harmless.
template <class T>
CONTROLMM_INLINE Lanes<T> load_strided(const T* p, std::int64_t stride, std::int64_t n) {
  if (stride == 1) return n == kLanes ? load(p) : load_first(p, n);
  if (stride == 0) return broadcast(*p);
  T buffer[kLanes] = {};
  for (std::int64_t i = 0; i < n; ++i) buffer[i] = p[i * stride];
  return load(buffer);
}
template <class T>
CONTROLMM_INLINE void store_strided(T* p, std::int64_t stride, std::int64_t n, const Lanes<T>& a) {
  if (stride == 1) return n == kLanes ? store(p, a) : store_first(p, n, a);
  T buffer[kLanes];
  store(buffer, a);
  for (std::int64_t i = 0; i < n; ++i) p[i * stride] = buffer[i];
}

// Lanes whose byte is not 0.
template <class T>
CONTROLMM_INLINE Mask<T> load_mask(const std::uint8_t* p) {
#if defined(__AVX512F__)
  const __m128i bytes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(p));
  const unsigned bits = _mm_test_epi8_mask(bytes, bytes);
  return map_mask<sizeof(T)>([bits](std::size_t i) __attribute__((always_inline)) { return bits >> (8 * i); },
                             std::make_index_sequence<Mask<T>::kParts>{});
#else
  typename IntOf<T>::type lanes[kLanes];
  for (std::int64_t i = 0; i < kLanes; ++i) lanes[i] = p[i];
  return load(lanes) > zeros<typename IntOf<T>::type>();
#endif
}
template <class T>
CONTROLMM_INLINE Mask<T> load_mask(const std::uint8_t* p, std::int64_t stride, std::int64_t n) {
  if (stride == 1 && n == kLanes) return load_mask<T>(p);
  std::uint8_t bytes[kLanes] = {};
  for (std::int64_t i = 0; i < n; ++i) bytes[i] = p[i * stride];
  return load_mask<T>(bytes);
}
