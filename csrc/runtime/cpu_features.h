#pragma once

namespace controlmm {

/// True if this processor and its operating system run the instruction set of that name.
bool cpu_supports(const char* isa);

}  // namespace controlmm
