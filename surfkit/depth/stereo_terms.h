// Numbers of PatchMatch that the kernels of the CPU and of a GPU have in common.
#pragma once

namespace surfkit {

constexpr int kSamples = 32;    // most pixels of a window that are compared
constexpr int kRadius = 8;      // most pixels from the middle of a window to its border
constexpr int kMostViews = 16;  // that one picture is compared with
constexpr int kBorder = 32;     // pixels by which pictures to compare with are continued

constexpr float kNoise = 1.0f;      // variance of grey values below which a window shows nothing
constexpr float kTiny = 1e-30f;     // added to weights, which may all be zero where the middle of a window is not compared
constexpr float kNothing = 2.0f;    // cost of a plane that a view does not show; more than that of any match
constexpr float kOblique = 0.12f;   // least cosine between the normal of a plane and the ray
constexpr float kMostError = 3.0f;  // pixels of reprojection
constexpr float kMostBend = 2.0f;   // pixels of parallax between neighbours; more is an edge
constexpr float kSame = 0.12f;      // pixels of parallax by which planes must differ in a window to be tried both
constexpr float kAcross = 5.0f;     // pixels over which a difference of slopes counts in that
constexpr float kHidden = 0.3f;     // cost above the best view's at which a view counts 1 / e of it
constexpr float kDark = 50.0f;     // grey value below which relative differences of brightness count less and less
constexpr float kUnlike = 0.5f;     // most that a difference of brightness costs
constexpr float kFaint = 20.0f;     // variance of grey values at which a window doubles the smoothness
constexpr float kNever = 1e9f;      // cost of a plane that is not tried
constexpr int kLooked = 2;          // views that are looked at, for each one that counts
constexpr int kKept = 6;            // planes that are looked at in all of these views, after the first half of them
constexpr int kFarthest = 11;       // pixels away, in each direction, from which planes are taken
constexpr int kFraction = 6, kOne = 1 << kFraction;  // of a pixel, to which positions are rounded

}  // namespace surfkit
