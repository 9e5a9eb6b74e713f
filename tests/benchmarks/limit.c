/* The limit for position + quaternion of three segments: one fused loop, structure of arrays.
 * Same mathematics as muxjax.batched; compiled on the spot by kinematics.py. */
#include <stddef.h>

static inline float sinc_x(float x) {
    return 0.9999999956988095f +
           x * (-0.16666657947846286f +
                x * (0.008333050170675f + x * (-0.00019809017408804543f + x * 2.6051076354857e-06f)));
}

static inline float cos_x(float x) {
    return 0.9999999997791542f +
           x * (-0.49999999355437613f +
                x * (0.04166663615971147f +
                     x * (-0.0013888360284248637f +
                          x * (2.4760109665272736e-05f - x * 2.60506573553671e-07f))));
}

void poses(size_t n, const float *restrict u, const float *restrict length, float *restrict out) {
    const float *u0 = u, *u1 = u + n, *u2 = u + 2 * n, *u3 = u + 3 * n, *u4 = u + 4 * n,
                *u5 = u + 5 * n;
    float *px = out, *py = out + n, *pz = out + 2 * n, *qw = out + 3 * n, *qx = out + 4 * n,
          *qy = out + 5 * n, *qz = out + 6 * n;
    const float l0 = length[0], l1 = length[1], l2 = length[2];
#pragma GCC ivdep
    for (size_t k = 0; k < n; k++) {
        float a = u4[k], b = u5[k], t = 0.25f * (a * a + b * b);
        float s = sinc_x(t), c = cos_x(t), ex = 0.5f * s * a, ey = 0.5f * s * b, d = l2 * s;
        float x = d * ex, y = d * ey, z = d * c, w = c, i = -ey, j = ex;

        a = u2[k], b = u3[k], t = 0.25f * (a * a + b * b);
        s = sinc_x(t), c = cos_x(t), ex = 0.5f * s * a, ey = 0.5f * s * b, d = l1 * s;
        float g = ex * x + ey * y, h = 2 * (c * z - g) + d;
        x += h * ex, y += h * ey, z = z * (2 * c * c - 1) + c * (d - 2 * g);
        float w1 = c * w + ey * i - ex * j, i1 = c * i - ey * w, j1 = c * j + ex * w,
              k1 = -ey * j - ex * i;

        a = u0[k], b = u1[k], t = 0.25f * (a * a + b * b);
        s = sinc_x(t), c = cos_x(t), ex = 0.5f * s * a, ey = 0.5f * s * b, d = l0 * s;
        g = ex * x + ey * y, h = 2 * (c * z - g) + d;
        px[k] = x + h * ex, py[k] = y + h * ey, pz[k] = z * (2 * c * c - 1) + c * (d - 2 * g);
        qw[k] = c * w1 + ey * i1 - ex * j1;
        qx[k] = c * i1 - ey * w1 + ex * k1;
        qy[k] = c * j1 + ey * k1 + ex * w1;
        qz[k] = c * k1 - ey * j1 - ex * i1;
    }
}
