// What ellipsoids hide of points, evaluated in space along the rays.
#pragma once

#include "pass.h"

namespace surfkit {

// 1 - product of 1 - alpha of the ellipsoids on the way to points (x px, y px, z), each with its largest density between
// the near plane and the point, or as stochastic solids; NaN where the points are not in view.
void ray_opacity(const SplatArrays& splats, const splat::CameraModel<double>& camera, const double* points,
                 int64_t count, bool solid, float* opacity, int threads);

}  // namespace surfkit
