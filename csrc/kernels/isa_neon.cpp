#define CONTROLMM_ISA neon
#include "isa_table.inl"
