#pragma once

#include <nanobind/nanobind.h>

namespace surfkit {

void add_stereo(nanobind::module_& m);

}  // namespace surfkit
