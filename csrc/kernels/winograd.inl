// Winograd's minimal filtering F(4, 3) (Lavin and Gray 2016): four outputs of a filter of three taps for six products
// instead of twelve. What lies around the products: sums of six inputs, and sums of six products.

template <class T>
CONTROLMM_INLINE T times(T a, int factor) {
  return a * static_cast<T>(factor);
}
template <class T>
CONTROLMM_INLINE Lanes<T> times(const Lanes<T>& a, int factor) {
  return a * broadcast(static_cast<T>(factor));
}

// Sixteen channels at once, then the last ones one by one; `f` reads and writes at a channel, as what it is given.
template <class T, class F>
CONTROLMM_INLINE void over_channels(std::int64_t channels, F f) {
  std::int64_t c = 0;
  for (; c + kLanes <= channels; c += kLanes)
    f([c](const T* p) __attribute__((always_inline)) { return load(p + c); },
      [c](T* p, const Lanes<T>& v) __attribute__((always_inline)) { store(p + c, v); });
  for (; c < channels; ++c)
    f([c](const T* p) __attribute__((always_inline)) { return p[c]; },
      [c](T* p, T v) __attribute__((always_inline)) { p[c] = v; });
}

template <class T>
void winograd_parts(const WinogradPartsArgs<T>& args) {
  for (std::int64_t tile = 0; tile < args.tiles; ++tile) {
    const T* in[6];
    T* out[6];
    for (int i = 0; i < 6; ++i) {
      const std::int64_t row = args.rows[6 * tile + i];
      in[i] = row < 0 ? args.zeros : args.x + row * args.channels;
      out[i] = args.parts + (i * args.tiles + tile) * args.channels;
    }
    over_channels<T>(args.channels, [&](auto get, auto put) __attribute__((always_inline)) {
      const auto a = get(in[0]), b = get(in[1]), c = get(in[2]), d = get(in[3]), e = get(in[4]), f = get(in[5]);
      const auto even = e - times(c, 4), odd = d - times(b, 4), near = e - c, far = times(d - b, 2);
      put(out[0], times(a - c, 4) + (e - c));
      put(out[1], even + odd);
      put(out[2], even - odd);
      put(out[3], near + far);
      put(out[4], near - far);
      put(out[5], times(b - d, 4) + (f - d));
    });
  }
}

template <class T>
CONTROLMM_INLINE T rectified(T a) {
  return a < 0 ? T(0) : a;  // one that is no number stays
}
template <class T>
CONTROLMM_INLINE Lanes<T> rectified(const Lanes<T>& a) {
  return select(a < zeros<T>(), zeros<T>(), a);
}

template <class T>
void winograd_frames(const WinogradFramesArgs<T>& args) {
  for (std::int64_t tile = 0; tile < args.tiles; ++tile) {
    const T* in[6];
    T* out[4];
    for (int i = 0; i < 6; ++i) in[i] = args.products + (i * args.tiles + tile) * args.channels;
    for (int i = 0; i < 4; ++i) {
      const std::int64_t row = args.rows[4 * tile + i];
      out[i] = row < 0 ? args.discarded : args.y + row * args.channels;
    }
    over_channels<T>(args.channels, [&](auto get, auto put) __attribute__((always_inline)) {
      const auto b = get(in[1]), c = get(in[2]), d = get(in[3]), e = get(in[4]), bias = get(args.bias);
      const auto near = b + c, far = d + e, slope = b - c, steep = d - e;
      const auto finish = [&](int i, const auto& value) __attribute__((always_inline)) {
        const auto y = value + bias;
        put(out[i], args.is_rectified ? rectified(y) : y);
      };
      finish(0, get(in[0]) + near + far);
      finish(1, slope + times(steep, 2));
      finish(2, near + times(far, 4));
      finish(3, slope + times(steep, 8) + get(in[5]));
    });
  }
}
