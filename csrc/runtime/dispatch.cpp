#include "controlmm/dispatch.h"

#include <atomic>
#include <cstdlib>
#include <stdexcept>

#include "cpu_features.h"
#include "kernel_table.h"

namespace controlmm {

#define CONTROLMM_DECLARE_TABLE(isa) \
  namespace isa {                    \
  extern const KernelTable table;    \
  }
#if defined(__x86_64__)
CONTROLMM_DECLARE_TABLE(baseline)
CONTROLMM_DECLARE_TABLE(avx2)
CONTROLMM_DECLARE_TABLE(avx512)
#elif defined(__aarch64__)
CONTROLMM_DECLARE_TABLE(neon)
#else
CONTROLMM_DECLARE_TABLE(baseline)
#endif
#undef CONTROLMM_DECLARE_TABLE

namespace {

// Slowest first.
const KernelTable* const kTables[] = {
#if defined(__x86_64__)
    &baseline::table,
    &avx2::table,
    &avx512::table,
#elif defined(__aarch64__)
    &neon::table,
#else
    &baseline::table,
#endif
};

std::string joined(const std::vector<std::string>& names) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
}

const KernelTable* find_table(const std::string& name) {
  for (const KernelTable* table : kTables)
    if (name == table->name && cpu_supports(table->name)) return table;
  throw std::invalid_argument("`CONTROLMM_ISA` must be an instruction set this machine runs (" +
                              joined(available_isas()) + "), got '" + name + "'.");
}

const KernelTable* choose() {
  if (const char* forced = std::getenv("CONTROLMM_ISA"); forced != nullptr && *forced != '\0')
    return find_table(forced);
  return find_table(available_isas().back());
}

std::atomic<const KernelTable*> chosen{nullptr};

}  // namespace

std::vector<std::string> available_isas() {
  std::vector<std::string> names;
  for (const KernelTable* table : kTables)
    if (cpu_supports(table->name)) names.emplace_back(table->name);
  return names;
}

const KernelTable& active_kernels() {
  const KernelTable* table = chosen.load(std::memory_order_acquire);
  if (table == nullptr) {
    table = choose();
    chosen.store(table, std::memory_order_release);
  }
  return *table;
}

std::string active_isa() { return active_kernels().name; }

void set_isa(const std::string& name) { chosen.store(find_table(name), std::memory_order_release); }

const char* version() { return CONTROLMM_VERSION; }

const char* compiler() {
#if defined(__clang__)
  return "clang " __clang_version__;
#else
  return "gcc " __VERSION__;
#endif
}

}  // namespace controlmm
