/* The pass over a record in modal form, as one would write it in C: sizes known to the compiler, states in registers.

   MODES pairs of poles; rows [z, w, u, e, y - x] (a pair has two rows of each), their second moments summed in blocks.
   Weights of a step, complex: decay, mixed, z_start, z_change, w_start, w_change; the input is held, the output joined
   by straight lines. */
#include <complex.h>
#include <string.h>

#define Q (6 * MODES + 2)
#define BLOCK 128
typedef double complex cx;

static void moments(double block[Q][BLOCK], int count, double *gram) {
    for (int i = 0; i < Q; i += 2)
        for (int j = i; j < Q; j += 2) {
            double a = 0, b = 0, c = 0, d = 0;
            for (int k = 0; k < count; k++) {
                a += block[i][k] * block[j][k];
                b += block[i][k] * block[j + 1][k];
                c += block[i + 1][k] * block[j][k];
                d += block[i + 1][k] * block[j + 1][k];
            }
            gram[i * Q + j] += a;
            gram[i * Q + j + 1] += b;
            gram[(i + 1) * Q + j] += c;
            gram[(i + 1) * Q + j + 1] += d;
        }
}

static void read_out(double block[Q][BLOCK], int k, const cx *z, const cx *w, const cx *e, const cx *residue, double u,
                     double y) {
    double x = 0;
    for (int i = 0; i < MODES; i++) {
        block[2 * i][k] = creal(z[i]), block[2 * i + 1][k] = cimag(z[i]);
        block[2 * MODES + 2 * i][k] = creal(w[i]), block[2 * MODES + 2 * i + 1][k] = cimag(w[i]);
        block[4 * MODES + 1 + 2 * i][k] = creal(e[i]), block[4 * MODES + 2 + 2 * i][k] = cimag(e[i]);
        x += creal(residue[i]) * creal(z[i]) - cimag(residue[i]) * cimag(z[i]);
    }
    block[4 * MODES][k] = u;
    block[Q - 1][k] = y - x;
}

/* A regular clock: the delay is shift intervals less a part of one, over which `part` reads out. */
void regular(const double *u, const double *y, long samples, long shift, int parted, const cx *whole, const cx *part,
             const cx *residue, double *gram) {
    cx z[MODES] = {0}, w[MODES] = {0}, e[MODES] = {0};
    static double block[Q][BLOCK];
    int filled = 0;
    memset(gram, 0, sizeof(double) * Q * Q);
    for (long k = 0; k < samples; k++) {
        double v = k >= shift ? u[k - shift] : 0;
        cx zr[MODES], wr[MODES];
        for (int i = 0; i < MODES; i++) {
            const cx *p = part + 6 * i;
            zr[i] = parted ? p[0] * z[i] + p[2] * v : z[i];
            wr[i] = parted ? p[0] * w[i] + p[1] * z[i] + p[4] * v : w[i];
        }
        read_out(block, filled, zr, wr, e, residue, v, y[k]);
        if (++filled == BLOCK) moments(block, BLOCK, gram), filled = 0;
        double change = k + 1 < samples ? y[k + 1] - y[k] : 0;
        for (int i = 0; i < MODES; i++) {
            const cx *p = whole + 6 * i;
            w[i] = p[0] * w[i] + p[1] * z[i] + p[4] * v;
            z[i] = p[0] * z[i] + p[2] * v;
            e[i] = p[0] * e[i] + p[2] * y[k] + p[3] * change;
        }
    }
    moments(block, filled, gram);
}

static void weights(cx pole, double h, cx *p) {
    static const double over[] = {1. / 2, 1. / 6, 1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880,
                                  1. / 3628800, 1. / 39916800, 1. / 479001600};
    cx x = pole * h, f, slope;
    if (creal(x) * creal(x) + cimag(x) * cimag(x) < .0225) {
        f = over[10], slope = 0;
        for (int k = 9; k >= 0; k--) slope = slope * x + f, f = f * x + over[k];
        p[0] = 1 + x * (1 + x * f);
    } else {
        cx r = 1 / x;
        p[0] = cexp(x);
        f = ((p[0] - 1) * r - 1) * r;
        slope = ((p[0] - 1) * r - 2 * f) * r;
    }
    p[1] = h * p[0], p[2] = h * (1 + x * f), p[3] = h * f, p[4] = h * h * (f + x * slope), p[5] = h * h * slope;
}

/* Any clock, common to input and output. */
void irregular(const double *t, const double *u, const double *y, long samples, double delay, const cx *pole,
               const cx *residue, double *gram) {
    cx z[MODES] = {0}, w[MODES] = {0}, e[MODES] = {0}, zr[MODES], wr[MODES], p[6];
    static double block[Q][BLOCK];
    int filled = 0;
    long j = -1;
    memset(gram, 0, sizeof(double) * Q * Q);
    for (long k = 0; k < samples; k++) {
        double instant = t[k] - delay;
        for (; j + 1 < samples && t[j + 1] <= instant; j++)
            for (int i = 0; i < MODES && j >= 0; i++) {
                weights(pole[i], t[j + 1] - t[j], p);
                w[i] = p[0] * w[i] + p[1] * z[i] + p[4] * u[j];
                z[i] = p[0] * z[i] + p[2] * u[j];
            }
        for (int i = 0; i < MODES; i++) {
            zr[i] = wr[i] = 0;
            if (j < 0) continue;
            weights(pole[i], instant - t[j], p);
            zr[i] = p[0] * z[i] + p[2] * u[j];
            wr[i] = p[0] * w[i] + p[1] * z[i] + p[4] * u[j];
        }
        read_out(block, filled, zr, wr, e, residue, j >= 0 ? u[j] : 0, y[k]);
        if (++filled == BLOCK) moments(block, BLOCK, gram), filled = 0;
        for (int i = 0; i < MODES && k + 1 < samples; i++) {
            weights(pole[i], t[k + 1] - t[k], p);
            e[i] = p[0] * e[i] + p[2] * y[k] + p[3] * (y[k + 1] - y[k]);
        }
    }
    moments(block, filled, gram);
}
