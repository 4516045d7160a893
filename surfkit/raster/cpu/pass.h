// One rendered view: projection, tile lists, blending, and the way back.
#pragma once

#include <cstdint>
#include <vector>

#include "doubles.h"
#include "../project.h"
#include "../native/buffer.h"
#include "kernels.h"

namespace surfkit {

struct GradientArrays {
    float *means, *quats, *scales, *opacities, *sh0, *sh_rest, *signal, *chosen;  // chosen may be null
};

// Rows of tiles [first, end) of an image, those that one process of several draws.
struct Strip {
    int first, end;
};
constexpr Strip kWholeImage = {0, 1 << 30};

class Pass {
  public:
    // Projects and bins. `seen` and `radii` are written for every splat. `rim`: 0.5 if pixel centres are to be drawn, 0
    // if anything between them. Outside the `strip` nothing is drawn, and its pixels get the bits of the whole image.
    // Splats of 0 coefficients have colours in the place of `sh0`, as `shade` gives them.
    Pass(Kind kind, const SplatArrays& splats, const splat::CameraModel<double>& camera, const GaussianForm& form,
         double rim, int threads, bool* seen, float* radii, Strip strip = kWholeImage);

    void forward(Level level, const Planes& out, int threads);
    // `absolute`: the pixels' shares of the chosen signal are summed without their signs. `out` has `rows` rows: those
    // of the first so many splats. All of it is written, zeros where a splat adds nothing.
    void backward(const SplatArrays& splats, const Planes& total, const Planes* chosen, bool absolute, int64_t rows,
                  const GradientArrays& out, int threads);
    void contribution(float alpha_power, float open_power, float* sum, int64_t* count, int threads);
    // Pixels in which each splat has both the largest weight and the median depth; written for those that are seen.
    void leading(int64_t* count, int threads);

    // 1 - product of 1 - alpha of the splats met on the way to points (x px, y px, z); NaN where they are not in view.
    void probe(const double* points, int64_t count, float* opacity, int threads);

    int64_t first_invalid = -1;  // a splat whose values are not finite or not positive; nothing else was done then
    int64_t pairs() const { return pairs_; }
    // Pairs of a splat and a tile by rows of tiles, tiles_y numbers: what a row costs, about.
    std::vector<int64_t> pairs_by_row() const;

  private:
    template <class Record>
    void project(const SplatArrays& splats, int threads, bool* seen, float* radii);
    void bin(int threads);
    bool solid() const { return form_.geometry == splat::kSolid; }
    Job job() const;
    Saved saved();
    template <class F>
    void each_seen(int threads, F f) const;

    Kind kind_;
    splat::CameraModel<double> camera_;
    GaussianForm form_;
    double rim_;
    Strip strip_;
    int64_t count_;
    int tiles_x_, tiles_y_;
    // Per projected splat; those of chunk c start at c * kChunk, their numbers are in seen_in_.
    Buffer<char> records_;
    Buffer<int64_t> index_;
    Buffer<float> depth_;
    Buffer<uint32_t> slot_, tiles_;
    std::vector<int32_t> seen_in_;
    std::vector<std::vector<uint32_t>> tiles_of_;  // per chunk, until they are sorted
    Buffer<Entry> entries_;
    int64_t pairs_ = 0;
    std::vector<int64_t> offsets_;
    // Saved by forward.
    Level level_ = kColor;
    std::vector<float> open_, m_shift_, m1_, m2_, solid_, fall_;
    std::vector<int32_t> last_, middle_;
    std::vector<uint64_t> blocks_;
};

// Which splats may touch a pixel: all that a Pass would draw, and some more. Only means and scales are read.
void in_view(Kind kind, const SplatArrays& splats, const splat::CameraModel<double>& camera, Strip strip, int threads,
             bool* found);

// Colours (count, 3) of the splats of some rows, below 0 too. And the other way: from gradients by them, (count, 3), to
// those by the coefficients of these rows, and to what is added to those of all means, (N, 3).
void shade(const SplatArrays& splats, const int64_t* rows, int64_t count, const splat::CameraModel<double>& camera,
           int threads, float* rgb);
void shade_backward(const SplatArrays& splats, const int64_t* rows, int64_t count,
                    const splat::CameraModel<double>& camera, int threads, const float* by_rgb, float* by_sh0,
                    float* by_sh_rest, float* by_means);

// The compilation in use, and those that this machine can run (best first).
const Kernels& kernels();
std::vector<const Kernels*> runnable_kernels();
void use_kernels(const Kernels& k);

double ssim(const float* x, const float* y, int channels, int width, int height, float* gradient, int threads);

// Mean over the inner pixels; the gradients by depth and normal are written. The job's own buffers are made here.
double normal_disagreement(NormalJob job, float* d_depth, int threads);

}  // namespace surfkit
