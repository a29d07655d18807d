// Truth values of sixteen lanes: bits where the processor has mask registers, whole lanes of ones elsewhere.

#if defined(__AVX512F__)
template <int Size>
struct MaskRegisterOf {
  using type = __mmask8;
};
template <>
struct MaskRegisterOf<4> {
  using type = __mmask16;
};
#else
template <int Size>
struct MaskRegisterOf {
  using type = typename RegisterOf<std::conditional_t<Size == 4, std::int32_t, std::int64_t> >::type;
};
#endif

template <int Size>
struct LaneMask {
  using Reg = typename MaskRegisterOf<Size>::type;
  static constexpr std::size_t kParts = static_cast<std::size_t>(kLanes * Size / kRegisterBytes);
  Reg part[kParts];
};
template <class T>
using Mask = LaneMask<sizeof(T)>;

template <int Size, class F, std::size_t... I>
CONTROLMM_INLINE LaneMask<Size> map_mask(F f, std::index_sequence<I...>) {
  using Reg = typename LaneMask<Size>::Reg;
  return {{static_cast<Reg>(f(I))...}};
}

#if defined(__AVX512F__)
template <int Predicate>
CONTROLMM_INLINE __mmask16 compare_registers(RegisterOf<float>::type a, RegisterOf<float>::type b) {
  return _mm512_cmp_ps_mask(a, b, Predicate);
}
template <int Predicate>
CONTROLMM_INLINE __mmask8 compare_registers(RegisterOf<double>::type a, RegisterOf<double>::type b) {
  return _mm512_cmp_pd_mask(a, b, Predicate);
}
CONTROLMM_INLINE RegisterOf<float>::type select_register(__mmask16 m, RegisterOf<float>::type a,
                                                         RegisterOf<float>::type b) {
  return _mm512_mask_blend_ps(m, b, a);
}
CONTROLMM_INLINE RegisterOf<double>::type select_register(__mmask8 m, RegisterOf<double>::type a,
                                                          RegisterOf<double>::type b) {
  return _mm512_mask_blend_pd(m, b, a);
}
#define CONTROLMM_COMPARE_REGISTERS(op, predicate, x, y) compare_registers<predicate>(x, y)
#else
template <class M, class R>
CONTROLMM_INLINE R select_register(M m, R a, R b) {
  return m ? a : b;
}
#define CONTROLMM_COMPARE_REGISTERS(op, predicate, x, y) (x) op(y)
#endif

// False wherever an operand is NaN, as for single numbers.
#define CONTROLMM_LANE_COMPARISON(op, predicate)                                   \
  template <class T>                                                               \
  CONTROLMM_INLINE Mask<T> operator op(const Lanes<T>& a, const Lanes<T>& b) {     \
    return map_mask<sizeof(T)>(                                                    \
        [&](std::size_t i) __attribute__((always_inline)) {                        \
          return CONTROLMM_COMPARE_REGISTERS(op, predicate, a.part[i], b.part[i]); \
        },                                                                         \
        std::make_index_sequence<Mask<T>::kParts>{});                              \
  }
CONTROLMM_LANE_COMPARISON(<, _CMP_LT_OQ)
CONTROLMM_LANE_COMPARISON(>, _CMP_GT_OQ)
CONTROLMM_LANE_COMPARISON(<=, _CMP_LE_OQ)
CONTROLMM_LANE_COMPARISON(>=, _CMP_GE_OQ)
CONTROLMM_LANE_COMPARISON(==, _CMP_EQ_OQ)
#undef CONTROLMM_LANE_COMPARISON
#undef CONTROLMM_COMPARE_REGISTERS

template <int Size>
CONTROLMM_INLINE LaneMask<Size> operator&(const LaneMask<Size>& a, const LaneMask<Size>& b) {
  return map_mask<Size>([&](std::size_t i) __attribute__((always_inline)) { return a.part[i] & b.part[i]; },
                        std::make_index_sequence<LaneMask<Size>::kParts>{});
}
template <int Size>
CONTROLMM_INLINE LaneMask<Size> operator|(const LaneMask<Size>& a, const LaneMask<Size>& b) {
  return map_mask<Size>([&](std::size_t i) __attribute__((always_inline)) { return a.part[i] | b.part[i]; },
                        std::make_index_sequence<LaneMask<Size>::kParts>{});
}
template <int Size>
CONTROLMM_INLINE LaneMask<Size> operator~(const LaneMask<Size>& a) {
  return map_mask<Size>([&](std::size_t i) __attribute__((always_inline)) { return ~a.part[i]; },
                        std::make_index_sequence<LaneMask<Size>::kParts>{});
}

#if defined(__AVX512F__)
CONTROLMM_INLINE bool any_in_register(unsigned m) { return m != 0; }
#elif defined(__AVX2__)
template <class M>
CONTROLMM_INLINE bool any_in_register(M m) {
  return _mm256_movemask_ps(reinterpret_cast<__m256>(m)) != 0;
}
#elif defined(__SSE2__)
template <class M>
CONTROLMM_INLINE bool any_in_register(M m) {
  return _mm_movemask_ps(reinterpret_cast<__m128>(m)) != 0;
}
#else
template <class M>
CONTROLMM_INLINE bool any_in_register(M m) {
  return vmaxvq_u32(reinterpret_cast<uint32x4_t>(m)) != 0;
}
#endif
template <int Size, std::size_t... I>
CONTROLMM_INLINE bool any_part(const LaneMask<Size>& m, std::index_sequence<I...>) {
  return any_in_register((m.part[I] | ...));
}
template <int Size>
CONTROLMM_INLINE bool any(const LaneMask<Size>& m) {
  return any_part(m, std::make_index_sequence<LaneMask<Size>::kParts>{});
}

template <class T, std::size_t... I>
CONTROLMM_INLINE Lanes<T> select_parts(const Mask<T>& m, const Lanes<T>& a, const Lanes<T>& b,
                                       std::index_sequence<I...>) {
  return {{select_register(m.part[I], a.part[I], b.part[I])...}};
}
// Takes `a` where the mask is set. Unlike a product with 0 or 1 this keeps NaN where it is.
template <class T>
CONTROLMM_INLINE Lanes<T> select(const Mask<T>& m, const Lanes<T>& a, const Lanes<T>& b) {
  return select_parts(m, a, b, Parts<T>{});
}
template <class T>
CONTROLMM_INLINE Lanes<T> abs(const Lanes<T>& a) {
  return select(a < zeros<T>(), zeros<T>() - a, a);
}
template <class T>
CONTROLMM_INLINE Lanes<T> sign(const Lanes<T>& a) {
  const Lanes<T> zero = zeros<T>(), one = broadcast(T{1});
  // A NaN stays NaN: a broken position must show, not look like a perfect one.
  return select(a > zero, one, select(a < zero, zero - one, a));
}

template <class T>
CONTROLMM_INLINE Mask<T> first_lanes(std::int64_t n) {
  constexpr T kIndex[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  return load(kIndex) < broadcast(static_cast<T>(n));
}
