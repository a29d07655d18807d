// Symmetric positive definite systems whose entries lie near the diagonal: A = C D^-1 C^T, column by column. Every
// element sees its updates in the same order whatever the registers' width, so all instruction sets agree to the bit.

class Banded {
 public:
  /// @param memory `banded_scratch(unknowns, reach)` doubles.
  /// @param reach  Farthest distance of an entry from the diagonal.
  Banded(double* memory, std::int64_t unknowns, std::int64_t reach)
      : columns_(memory), count_(unknowns), reach_(reach), stride_(banded_stride(reach)) {
    clear();
  }

  void clear() { __builtin_memset(columns_, 0, static_cast<std::size_t>(count_ * stride_) * sizeof(double)); }

  void add(std::int64_t i, std::int64_t j, double value) {
    const std::int64_t row = i > j ? i : j, col = i > j ? j : i;
    column(col)[row - col] += value;
  }

  /// `weight` times the square of `unknown[i] - unknown[j]`, as its share of the matrix.
  void tie(std::int64_t i, std::int64_t j, double weight) {
    add(i, i, weight);
    add(j, j, weight);
    add(i, j, -weight);
  }

  /// Fixes the unknowns whose flag is set at what `right` has for them; flag of unknown i: `is_held[i * flag_stride]`.
  void hold(const std::uint8_t* is_held, std::int64_t flag_stride, double* right) {
    const auto fix = [&](double& entry, std::int64_t held, std::int64_t other) {
      if (entry == 0) return;  // most are: this spares the flags
      if (!is_held[other * flag_stride]) right[other] -= entry * right[held];
      entry = 0;
    };
    for (std::int64_t j = 0; j < count_; ++j) {
      if (!is_held[j * flag_stride]) continue;
      const std::int64_t first = j < reach_ ? 0 : j - reach_;
      for (std::int64_t i = first; i < j; ++i) fix(column(i)[j - i], j, i);
      for (std::int64_t i = 1; i <= last(j); ++i) fix(column(j)[i], j, j + i);
      column(j)[0] = 1;
    }
  }

  // Four columns at a time, so that a column behind them is loaded and stored once for four.
  void factorise() {
    for (std::int64_t j = 0; j < count_; j += kPanel) {
      const std::int64_t panel = count_ - j < kPanel ? count_ - j : kPanel;
      double inverse[kPanel];
      for (std::int64_t p = 0; p < panel; ++p) {
        const double* col = column(j + p);
        inverse[p] = 1 / col[0];
        for (std::int64_t i = 1; i < panel - p; ++i)
          subtract(column(j + p + i), col[i] * inverse[p], col + i, reach_ + 1 - i);
      }
      if (panel < kPanel) return;  // nothing is behind
      const std::int64_t end = j + kPanel + reach_ < count_ ? j + kPanel + reach_ : count_;
      for (std::int64_t row = j + kPanel; row < end; ++row) subtract_panel(j, row, inverse);
    }
  }

  /// @param x Right side, then solution; readable for `banded_stride(reach)` doubles past its end, zero there.
  void solve(double* x) const {
    for (std::int64_t j = 0; j < count_; ++j) {
      const double* col = column(j);
      x[j] /= col[0];
      if (x[j] != 0)
        for (std::int64_t i = 1; i <= last(j); ++i) x[j + i] -= col[i] * x[j];
    }
    for (std::int64_t j = count_ - 1; j >= 0; --j) x[j] -= dot(column(j) + 1, x + j + 1, reach_) / column(j)[0];
  }

 private:
  double* column(std::int64_t j) const { return columns_ + j * stride_; }
  std::int64_t last(std::int64_t j) const { return reach_ < count_ - 1 - j ? reach_ : count_ - 1 - j; }

  // Whole blocks: what lies past the band is zero in `from`, and nobody's in `to`.
  static CONTROLMM_INLINE void subtract(double* to, double factor, const double* from, std::int64_t n) {
    const Lanes<double> f = broadcast(factor);
    for (std::int64_t k = 0; k < n; k += kLanes) store(to + k, load(to + k) - f * load(from + k));
  }
  // What the columns from j on leave of a later one.
  CONTROLMM_INLINE void subtract_panel(std::int64_t j, std::int64_t row, const double* inverse) const {
    const double* from[kPanel];
    double factor[kPanel];
    bool any = false;
    for (std::int64_t p = 0; p < kPanel; ++p) {
      from[p] = column(j + p) + (row - j - p);
      factor[p] = from[p][0] * inverse[p];
      any = any || factor[p] != 0;
    }
    if (!any) return;
    double* to = column(row);
    const Lanes<double> a = broadcast(factor[0]), b = broadcast(factor[1]), c = broadcast(factor[2]),
                        d = broadcast(factor[3]);
    const std::int64_t n = reach_ + kPanel - (row - j);  // rows that the last of them reaches
    for (std::int64_t k = 0; k < n; k += kLanes) {
      const Lanes<double> left = load(to + k) - a * load(from[0] + k) - b * load(from[1] + k);
      store(to + k, left - c * load(from[2] + k) - d * load(from[3] + k));
    }
  }
  static CONTROLMM_INLINE double dot(const double* a, const double* b, std::int64_t n) {
    Lanes<double> total = zeros<double>();
    for (std::int64_t k = 0; k < n; k += kLanes) total = total + load(a + k) * load(b + k);
    return sum(total);
  }

  double* columns_;
  std::int64_t count_, reach_, stride_;
};
