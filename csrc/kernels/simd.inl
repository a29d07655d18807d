// Sixteen values of one type, held in as many native registers as that takes. Plain loops are left scalar by some
// compilers; here the vector shape is explicit, and the order of every sum is the same on every instruction set.

#if defined(__AVX512F__)
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif

#define CONTROLMM_INLINE inline __attribute__((always_inline))

template <class T>
struct IntOf;
template <>
struct IntOf<float> {
  using type = std::int32_t;
};
template <>
struct IntOf<double> {
  using type = std::int64_t;
};
template <>
struct IntOf<std::int32_t> {
  using type = std::int32_t;
};
template <>
struct IntOf<std::uint32_t> {
  using type = std::int32_t;
};
template <>
struct IntOf<std::int64_t> {
  using type = std::int64_t;
};

template <class T, int Bytes = kRegisterBytes>
struct RegisterOf {
  typedef T type __attribute__((vector_size(Bytes)));
  typedef T unaligned __attribute__((vector_size(Bytes), aligned(alignof(T)), may_alias));
};

template <class T>
struct Lanes {
  using Reg = typename RegisterOf<T>::type;
  static constexpr int kWidth = kRegisterBytes / static_cast<int>(sizeof(T));
  static constexpr int kParts = static_cast<int>(kLanes) / kWidth;
  Reg part[kParts];
};

template <class T>
using Parts = std::make_index_sequence<static_cast<std::size_t>(Lanes<T>::kParts)>;

// Pack expansion rather than a loop: the optimiser then keeps every part in a register.
template <class R, class T, class F, std::size_t... I>
CONTROLMM_INLINE Lanes<R> map_parts(F f, const Lanes<T>& a, std::index_sequence<I...>) {
  return {{f(a.part[I])...}};
}
template <class R, class T, class U, class F, std::size_t... I>
CONTROLMM_INLINE Lanes<R> map_parts(F f, const Lanes<T>& a, const Lanes<U>& b, std::index_sequence<I...>) {
  return {{f(a.part[I], b.part[I])...}};
}

#define CONTROLMM_LANE_OPERATOR(op)                                                                              \
  template <class T>                                                                                             \
  CONTROLMM_INLINE Lanes<T> operator op(const Lanes<T>& a, const Lanes<T>& b) {                                  \
    return map_parts<T>([](auto x, auto y) __attribute__((always_inline)) { return x op y; }, a, b, Parts<T>{}); \
  }
CONTROLMM_LANE_OPERATOR(+)
CONTROLMM_LANE_OPERATOR(-)
CONTROLMM_LANE_OPERATOR(*)
CONTROLMM_LANE_OPERATOR(/)
CONTROLMM_LANE_OPERATOR(&)
CONTROLMM_LANE_OPERATOR(|)
CONTROLMM_LANE_OPERATOR(^)
CONTROLMM_LANE_OPERATOR(<<)
CONTROLMM_LANE_OPERATOR(>>)
#undef CONTROLMM_LANE_OPERATOR

template <class T, std::size_t... I>
CONTROLMM_INLINE Lanes<T> broadcast_parts(T value, std::index_sequence<I...>) {
  using Reg = typename Lanes<T>::Reg;
  return {{(static_cast<void>(I), value - Reg{})...}};  // minus zero keeps the sign of a negative zero
}
template <class T>
CONTROLMM_INLINE Lanes<T> broadcast(T value) {
  return broadcast_parts(value, Parts<T>{});
}
template <class T>
CONTROLMM_INLINE Lanes<T> zeros() {
  return Lanes<T>{};
}

template <class T, std::size_t... I>
CONTROLMM_INLINE Lanes<T> load_parts(const T* p, std::index_sequence<I...>) {
  using Unaligned = typename RegisterOf<T>::unaligned;
  return {{static_cast<typename Lanes<T>::Reg>(
      *reinterpret_cast<const Unaligned*>(p + I * static_cast<std::size_t>(Lanes<T>::kWidth)))...}};
}
template <class T>
CONTROLMM_INLINE Lanes<T> load(const T* p) {
  return load_parts(p, Parts<T>{});
}

template <class T, std::size_t... I>
CONTROLMM_INLINE void store_parts(T* p, const Lanes<T>& a, std::index_sequence<I...>) {
  using Unaligned = typename RegisterOf<T>::unaligned;
  ((*reinterpret_cast<Unaligned*>(p + I * static_cast<std::size_t>(Lanes<T>::kWidth)) = a.part[I]), ...);
}
template <class T>
CONTROLMM_INLINE void store(T* p, const Lanes<T>& a) {
  store_parts(p, a, Parts<T>{});
}

CONTROLMM_INLINE RegisterOf<float>::type sqrt_register(RegisterOf<float>::type a) {
#if defined(__AVX512F__)
  return _mm512_maskz_sqrt_ps(0xFFFF, a);  // the unmasked form warns falsely in g++ 12
#elif defined(__AVX2__)
  return _mm256_sqrt_ps(a);
#elif defined(__SSE2__)
  return _mm_sqrt_ps(a);
#else
  return vsqrtq_f32(a);
#endif
}
CONTROLMM_INLINE RegisterOf<double>::type sqrt_register(RegisterOf<double>::type a) {
#if defined(__AVX512F__)
  return _mm512_maskz_sqrt_pd(0xFF, a);
#elif defined(__AVX2__)
  return _mm256_sqrt_pd(a);
#elif defined(__SSE2__)
  return _mm_sqrt_pd(a);
#else
  return vsqrtq_f64(a);
#endif
}
template <class T>
CONTROLMM_INLINE Lanes<T> sqrt(const Lanes<T>& a) {
  return map_parts<T>([](auto x) __attribute__((always_inline)) { return sqrt_register(x); }, a, Parts<T>{});
}

// Sum of a register by halves: lane i meets lane i + width / 2. The same tree whatever the register width.
template <class T, int Bytes>
CONTROLMM_INLINE T sum_by_halves(typename RegisterOf<T, Bytes>::type a) {
  if constexpr (Bytes == 2 * sizeof(T)) {
    return a[0] + a[1];
  } else {
    typename RegisterOf<T, Bytes / 2>::type half[2];
    __builtin_memcpy(half, &a, Bytes);
    return sum_by_halves<T, Bytes / 2>(half[0] + half[1]);
  }
}
template <class T>
CONTROLMM_INLINE T sum(const Lanes<T>& a) {
  constexpr int kParts = Lanes<T>::kParts;
  if constexpr (kParts == 1) {
    return sum_by_halves<T, kRegisterBytes>(a.part[0]);
  } else if constexpr (kParts == 2) {
    return sum_by_halves<T, kRegisterBytes>(a.part[0] + a.part[1]);
  } else if constexpr (kParts == 4) {
    return sum_by_halves<T, kRegisterBytes>((a.part[0] + a.part[2]) + (a.part[1] + a.part[3]));
  } else {
    return sum_by_halves<T, kRegisterBytes>(((a.part[0] + a.part[4]) + (a.part[2] + a.part[6])) +
                                            ((a.part[1] + a.part[5]) + (a.part[3] + a.part[7])));
  }
}

template <class To, class From>
CONTROLMM_INLINE Lanes<To> bits_of(const Lanes<From>& a) {
  Lanes<To> b;
  static_assert(sizeof a == sizeof b);
  __builtin_memcpy(&b, &a, sizeof b);
  return b;
}

template <class To, class From>
CONTROLMM_INLINE Lanes<To> converted(const Lanes<From>& a) {
  using Reg = typename Lanes<To>::Reg;
  return map_parts<To>([](auto x) __attribute__((always_inline)) { return __builtin_convertvector(x, Reg); }, a,
                       Parts<From>{});
}

CONTROLMM_INLINE Lanes<double> to_double(const Lanes<double>& a) { return a; }
CONTROLMM_INLINE Lanes<double> to_double(const Lanes<float>& a) {
  float narrow[kLanes];
  double wide[kLanes];
  store(narrow, a);
  for (int i = 0; i < kLanes; ++i) wide[i] = static_cast<double>(narrow[i]);
  return load(wide);
}

template <class T>
CONTROLMM_INLINE Lanes<T> narrowed(const Lanes<double>& a) {
  if constexpr (sizeof(T) == 8) {
    return a;
  } else {
    double wide[kLanes];
    T narrow[kLanes];
    store(wide, a);
    for (int i = 0; i < kLanes; ++i) narrow[i] = static_cast<T>(wide[i]);
    return load(narrow);
  }
}
