// The functions of doubles that ../splat_math.h and ../project.h need.
#pragma once

#include <cmath>

typedef double Real;

static inline double square_root(double x) { return std::sqrt(x); }
static inline double natural_log(double x) { return std::log(x); }
static inline double rough(double x) { return x; }
static inline double round_down(double x) { return std::floor(x); }
