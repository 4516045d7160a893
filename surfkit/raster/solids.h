// The depth of gaussians as stochastic solids (Zhang et al. 2026, GGGS), per pixel, once for every backend.
//
// Along a ray the density of a gaussian is G(t) = G* exp(-curve (t - peak)^2 / 2), with the alpha of a picture, G*, at its
// peak. As a solid it leaves open v = sqrt(1 - G) up to the peak and v*^2 / v behind it (eq. 12). The depth is where all
// of them together leave a half (eq. 10, 11). Squares are multiplied here: T^2, which is to be a quarter.
#pragma once

#include "pixels.h"

namespace surfkit {
namespace {

// A search looks between some shares of a depth that is near, or at first else in a wider range; then it goes on by
// Newton's method, by halves where that would leave the interval, until a step is a small share of the depth.
constexpr int kShares = 6, kSteps = 24;
constexpr float kSettled = 2e-7f;
SPLAT_FN float share_of(bool wide, int k) {
    const int step = k < kShares / 2 ? kShares / 2 - k : k + 1 - kShares / 2;
    const float off = step == 1 ? (wide ? 0.04f : 0.002f) : step == 2 ? (wide ? 0.2f : 0.01f) : (wide ? 0.4f : 0.04f);
    return k < kShares / 2 ? 1 - off : 1 + off;
}
// Where a gaussian counts at all: farther from its peak, in sigmas, it is below what a float tells from 0.
constexpr float kReach = 6.0f, kCutoff = 3.329f;
SPLAT_FN float front_of(const LocalRay& s) { return s.z - kReach / kCutoff * (s.z_high - s.z); }
// Where the light falls by less than a factor e over the whole way from the camera, depth has no gradient: eq. 13 divides
// by that fall, and a surface takes a thousandth of the way or less.
constexpr float kLeastFall = 1.0f;

// A solid on the rays of some pixels; raw and alpha are 0 where it is not drawn.
struct OnRay {
    Floats raw, alpha, peak, curve;

    // G at depth t, not yet held at kAlphaMax.
    SURFKIT_INLINE Floats density(Floats t) const {
        const Floats off = t - peak;
        return raw * exp_negative(-0.5f * lower(curve * off * off, broadcast(100.0f)));
    }
    // The square of what is left open up to depth t.
    SURFKIT_INLINE Floats open_squared(Floats t) const {
        const Floats vacancy = 1.0f - lower(density(t), broadcast(kAlphaMax));
        return select(less_equal(t, peak), vacancy, behind() * reciprocal(vacancy));
    }
    SURFKIT_INLINE Floats behind() const { return (1.0f - alpha) * (1.0f - alpha); }
    // -d(log T) / dt at depth t, of this one.
    SURFKIT_INLINE Floats fall(Floats t) const {
        const Floats g = density(t);
        return keep(lesser(g, kAlphaMax), 0.5f * g * reciprocal(1.0f - g) * curve * magnitude(t - peak));
    }
    // Where all of it lies before or behind depth t.
    SURFKIT_INLINE Mask lies_before(Floats t) const { return lesser(peak, t) & is_far(t); }
    SURFKIT_INLINE Mask lies_behind(Floats t) const { return lesser(t, peak) & is_far(t); }

  private:
    SURFKIT_INLINE Mask is_far(Floats t) const { return lesser(kReach * kReach, curve * (t - peak) * (t - peak)); }
};
struct SolidPixel : OnRay {
    RayPixel at;

    // False if it is drawn at none of the pixels.
    SURFKIT_INLINE bool shape(const LocalRay& s, Floats x, Floats y) {
        at.shape(s, x, y);
        raw = s.opacity * exp_negative(-at.half_rho);
        alpha = lower(raw, broadcast(kAlphaMax));
        const Mask drawn = less_equal(kAlphaMin, alpha);
        if (!any(drawn)) return false;
        raw = keep(drawn, raw);
        alpha = keep(drawn, alpha);
        // With d the ray in units of the axes, z = 1 along it: curve = d.d, of which D / (kappa z^2) is another name.
        peak = keep(drawn, s.z * at.u * at.inv);
        curve = keep(drawn, reciprocal(at.inv * (s.kappa * s.z * s.z)));
        return true;
    }
};

// The search of some pixels.
struct Crossing {
    Floats low{}, high{}, t{}, step{};
    Mask found = lesser(broadcast(1.0f), 0.0f);

    // From the squares of what is left open at the shares of `start`; no depth is looked for where that is 0.
    SURFKIT_INLINE void begin(Floats start, const Floats* left, bool wide) {
        const Mask wanted = lesser(0.0f, start);
        for (int k = 0; k < kShares - 1; k++) {
            const Mask here = wanted & lesser(0.25f, left[k]) & less_equal(left[k + 1], 0.25f);
            const Floats from = start * share_of(wide, k), to = start * share_of(wide, k + 1);
            const Floats part = (left[k] - 0.25f) * reciprocal(higher(left[k] - left[k + 1], broadcast(1e-20f)));
            low = select(here, from, low);
            high = select(here, to, high);
            t = select(here, madd(part, to - from, from), t);
            step = select(here, to - from, step);
        }
        found = lesser(0.0f, high);
    }
    SURFKIT_INLINE Mask unsettled() const { return found & lesser(kSettled * t, magnitude(step)); }
    // By the square of what is open at t, and the fall of its logarithm.
    SURFKIT_INLINE void newton(Floats left, Floats fall) {
        const Mask is_open = lesser(0.25f, left);
        low = select(is_open, t, low);
        high = select(is_open, high, t);
        const Floats wanted = t + 2.0f * (left - 0.25f) * reciprocal(higher(fall, broadcast(1e-20f)));
        const Floats next = select(less_equal(low, wanted) & less_equal(wanted, high), wanted, 0.5f * (low + high));
        step = next - t;
        t = next;
    }
    SURFKIT_INLINE Floats depth(float near) const { return keep(found & less_equal(near, t), t); }
};

// What one solid does to the depth t of pixels: eq. 13, dt/d(theta) = d(log T)/d(theta) / fall. `by_log` is dL/dt / fall.
struct SolidShares {
    Floats by_power, by_peak, by_curve;  // dL/d(rho / 2), dL/d(peak), and dL/d(curve) times the curve

    static SURFKIT_INLINE SolidShares of(const SolidPixel& p, Floats t, Floats by_log) {
        const Floats g = p.density(t), off = t - p.peak;
        const Mask front = less_equal(t, p.peak);
        const Floats half = 0.5f * by_log * g * reciprocal(1.0f - lower(g, broadcast(kAlphaMax)));
        const Floats by_density = keep(lesser(g, kAlphaMax), select(front, -half, half));
        const Floats all = by_log * p.raw * reciprocal(1.0f - p.alpha);
        const Floats by_peak_density = keep(without(lesser(p.raw, kAlphaMax), front), -all);
        const Floats bent = by_density * p.curve * off;
        return {-(by_density + by_peak_density), bent, -0.5f * bent * off};
    }
};

// Adds to a RayAdder what a pixel's depth hands back to one solid, and its share of the chosen signal.
template <class Adder, int chosen>
SURFKIT_INLINE void add_solid(const SolidPixel& p, const LocalRay& s, const LocalSignal& signal, Floats t,
                              Floats by_log, Floats chosen_by_log, Adder& adder) {
    const SolidShares g = SolidShares::of(p, t, by_log);
    adder.add_opacity(-g.by_power * (1.0f / s.opacity));
    adder.add_bent(p.at, s, g.by_power, g.by_peak, g.by_curve);
    if (chosen == kChosenAll || chosen == kChosenAbsolute) {
        const SolidShares c = SolidShares::of(p, t, chosen_by_log);
        adder.add_chosen_bent(p.at, s, signal, c.by_power, c.by_peak, c.by_curve);
    }
}

}  // namespace
}  // namespace surfkit
