#define CONTROLMM_ISA avx2
#include "isa_table.inl"
