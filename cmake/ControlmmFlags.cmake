# Flags that every target of the project shares.
add_library(controlmm_flags INTERFACE)
target_compile_features(controlmm_flags INTERFACE cxx_std_17)
# No contraction: a product and a sum round alike on every instruction set, so results are bitwise equal.
target_compile_options(controlmm_flags INTERFACE
  -ffp-contract=off -fno-math-errno -fno-trapping-math -fvisibility=hidden
  -Wall -Wextra -Wpedantic -Wconversion)
if(CONTROLMM_WARNINGS_AS_ERRORS)
  target_compile_options(controlmm_flags INTERFACE -Werror)
endif()
if(CONTROLMM_SANITIZE)
  target_compile_options(controlmm_flags INTERFACE
    -fsanitize=${CONTROLMM_SANITIZE} -fno-sanitize-recover=all -fno-omit-frame-pointer -g)
  target_link_options(controlmm_flags INTERFACE -fsanitize=${CONTROLMM_SANITIZE})
endif()
