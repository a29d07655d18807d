#pragma once

#include <string>
#include <vector>

namespace controlmm {

/// Names of the instruction sets that were compiled in and that this processor runs, slowest first.
std::vector<std::string> available_isas();

/// The one in use. Decided at the first call: the environment variable CONTROLMM_ISA, else the fastest.
/// @throws std::invalid_argument if CONTROLMM_ISA names an unknown or unusable instruction set.
std::string active_isa();

/// Uses another one from now on, in all threads. Results do not change, only speed.
/// @throws std::invalid_argument for an unknown or unusable name.
void set_isa(const std::string& name);

/// Version of the library, the same as that of the Python package.
const char* version();

/// Name and version of the compiler that built the library.
const char* compiler();

}  // namespace controlmm
