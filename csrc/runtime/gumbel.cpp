#include "checks.h"
#include "clip_work.h"

namespace controlmm {
namespace {

constexpr double kNsPerDraw = 2.5, kNsPerSoftmax = 0.5;  // measured on one core, for each code

void check_codes_contiguous(const TensorView& logits) {
  if (logits.shape[2] > 1 && logits.strides[2] != 1)
    throw std::invalid_argument("`logits` must have contiguous codes, got stride " + std::to_string(logits.strides[2]) +
                                ".");
}

template <class T>
void run_over_rows(const GumbelArgs<T>& args, std::int64_t rows, int threads) {
  const auto kernel = active_kernels().of<T>().gumbel;
  const double work_ns = kNsPerDraw * static_cast<double>(rows * args.codes);
  run_over_clips(rows, work_ns, threads, 0, [&](ClipRange range, double*) { kernel(args, range); });
}

}  // namespace

void gumbel_noise(NoiseSource source, const TensorView& noise, int threads) {
  checks::for_dtype(noise, "noise", [&](auto zero) {
    using T = decltype(zero);
    checks::require(noise, "noise", 3, noise.dtype);
    checks::require_row_major(noise, "noise");
    if (noise.size() == 0) return;
    GumbelArgs<T> args{};
    args.tokens = noise.shape[1];
    args.codes = noise.shape[2];
    args.source = source;
    args.probabilities = noise.as<T>();
    run_over_rows(args, noise.shape[0] * noise.shape[1], threads);
  });
}

void gumbel_straight_through(const TensorView& logits, const TensorView& codebook, double temperature,
                             NoiseSource source, const TensorView& ids, const TensorView& embeddings,
                             const TensorView& probabilities, int threads) {
  checks::for_dtype(logits, "logits", [&](auto zero) {
    using T = decltype(zero);
    checks::require(logits, "logits", 3, logits.dtype);
    check_codes_contiguous(logits);
    const std::int64_t clips = logits.shape[0], tokens = logits.shape[1], codes = logits.shape[2];
    if (codes < 1) throw std::invalid_argument("`logits` must have at least one code, got 0.");
    if (!(temperature > 0)) throw std::invalid_argument("`temperature` must be above 0.");
    checks::require(codebook, "codebook", 2, logits.dtype);
    checks::require_shape(codebook, "codebook", {codes, codebook.shape[1]});
    checks::require_contiguous(codebook, "codebook");
    checks::require(ids, "ids", 2, DType::int64);
    checks::require_shape(ids, "ids", {clips, tokens});
    checks::require_row_major(ids, "ids");
    checks::require(embeddings, "embeddings", 3, logits.dtype);
    checks::require_shape(embeddings, "embeddings", {clips, tokens, embeddings.shape[2] == 0 ? 0 : codebook.shape[1]});
    checks::require_row_major(embeddings, "embeddings");
    checks::require(probabilities, "probabilities", 3, logits.dtype);
    const bool is_soft = probabilities.shape[2] != 0;
    checks::require_shape(probabilities, "probabilities", {clips, tokens, is_soft ? codes : 0});
    checks::require_row_major(probabilities, "probabilities");
    if (ids.size() == 0) return;
    const GumbelArgs<T> args{tokens,
                             codes,
                             embeddings.shape[2],
                             logits.as<const T>(),
                             logits.strides[0],
                             logits.strides[1],
                             codebook.as<const T>(),
                             static_cast<T>(temperature),
                             source,
                             ids.as<std::int64_t>(),
                             embeddings.as<T>(),
                             is_soft ? probabilities.as<T>() : nullptr};
    run_over_rows(args, clips * tokens, threads);
  });
}

void softmax_backward(const TensorView& probabilities, double temperature, const TensorView& gradient, int threads) {
  checks::for_dtype(probabilities, "probabilities", [&](auto zero) {
    using T = decltype(zero);
    checks::require(probabilities, "probabilities", 2, probabilities.dtype);
    checks::require_contiguous(probabilities, "probabilities");
    checks::require(gradient, "gradient", 2, probabilities.dtype);
    checks::require_shape(gradient, "gradient", {probabilities.shape[0], probabilities.shape[1]});
    checks::require_row_major(gradient, "gradient");
    if (!(temperature > 0)) throw std::invalid_argument("`temperature` must be above 0.");
    if (gradient.size() == 0) return;
    const SoftmaxArgs<T> args{probabilities.shape[1], probabilities.as<const T>(), static_cast<T>(1 / temperature),
                              gradient.as<T>()};
    const auto kernel = active_kernels().of<T>().softmax_backward;
    run_over_clips(gradient.shape[0], kNsPerSoftmax * static_cast<double>(gradient.size()), threads, 0,
                   [&](ClipRange range, double*) { kernel(args, range); });
  });
}

}  // namespace controlmm
