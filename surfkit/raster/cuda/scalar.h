// What ../pixels.h and ../project.h ask for: a thread has one pixel or one splat.
#pragma once

#include "pair.h"

typedef Pair Real;
typedef float Floats;
typedef int Ints;
typedef bool Mask;
#define SURFKIT_INLINE inline
#define SPLAT_FN inline

inline float square_root(float x) { return sqrtf(x); }
inline float natural_log(float x) { return logf(x); }
inline float round_down(float x) { return floorf(x); }

inline float broadcast(float x) { return x; }
inline float madd(float a, float b, float c) { return fmaf(a, b, c); }
inline float root(float x) { return sqrtf(x); }
inline float reciprocal(float x) { return 1.0f / x; }
inline float lower(float a, float b) { return fminf(a, b); }
inline float higher(float a, float b) { return fmaxf(a, b); }
inline float magnitude(float x) { return fabsf(x); }
inline float exp_negative(float x) { return __expf(x); }
inline float log_positive(float x) { return __logf(x); }

inline bool lesser(float a, float b) { return a < b; }
inline bool less_equal(float a, float b) { return a <= b; }
inline bool less_equal(int a, int b) { return a <= b; }
inline bool equal(int a, int b) { return a == b; }
inline bool without(bool a, bool b) { return a && !b; }
inline bool any(bool a) { return a; }
inline float select(bool m, float a, float b) { return m ? a : b; }
inline int select(bool m, int a, int b) { return m ? a : b; }
inline float keep(bool m, float a) { return m ? a : 0.0f; }
