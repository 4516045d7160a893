// The part of the module that meshes.
#pragma once

#include <nanobind/nanobind.h>

namespace surfkit {

void add_mesh(nanobind::module_& m);

}  // namespace surfkit
