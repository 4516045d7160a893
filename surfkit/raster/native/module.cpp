// The one native extension. Each folder with kernels brings its own part of it, in its cpu/bind.cpp.
#include <nanobind/nanobind.h>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace surfkit {

void add_raster(nanobind::module_& m);
void add_mesh(nanobind::module_& m);
void add_visibility(nanobind::module_& m);
void add_stereo(nanobind::module_& m);
void add_compress(nanobind::module_& m);
void add_texture(nanobind::module_& m);
void add_start(nanobind::module_& m);
void add_appearance(nanobind::module_& m);

namespace {

// Every step frees and takes the same buffers of some 10 to 100 MB. By default glibc gives each back to the system, which
// clears its pages anew: a sixth of the CPU time of a training.
void keep_freed_memory() {
#if defined(__GLIBC__)
    if (!mallopt(M_MMAP_THRESHOLD, 1 << 30)) mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 256 << 20);
#endif
}

}  // namespace
}  // namespace surfkit

NB_MODULE(_native, m) {
#if defined(__clang__)
    m.attr("compiler") = __VERSION__;  // begins with its name
#else
    m.attr("compiler") = "GCC " __VERSION__;
#endif
    surfkit::keep_freed_memory();
    surfkit::add_raster(m);
    surfkit::add_mesh(m);
    surfkit::add_visibility(m);
    surfkit::add_stereo(m);
    surfkit::add_compress(m);
    surfkit::add_texture(m);
    surfkit::add_start(m);
    surfkit::add_appearance(m);
}
