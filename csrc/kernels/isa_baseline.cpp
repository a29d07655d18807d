#define CONTROLMM_ISA baseline
#include "isa_table.inl"
