#define CONTROLMM_ISA avx512
#include "isa_table.inl"
