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

/* Decay of a mode over each gap of a block, and what an input linear over it adds to the mode and to its square: series
   for |pole gap| <= 1, which the compiler takes several at a time. */
static void steps(cx pole, int count, double in[3][BLOCK], double out[6][BLOCK]) {
    static const double over[] = {1. / 24, 1. / 120, 1. / 720, 1. / 5040, 1. / 40320, 1. / 362880, 1. / 3628800,
                                  1. / 39916800, 1. / 479001600, 1. / 6227020800., 1. / 87178291200.,
                                  1. / 1307674368000., 1. / 20922789888000., 1. / 355687428096000.,
                                  1. / 6402373705728000.};
    double p = creal(pole), q = cimag(pole);
    for (int k = 0; k < count; k++) {
        double h = in[0][k], v = in[1][k], c = in[2][k], re = p * h, im = q * h;
        double twice = 2 * re, square = re * re + im * im, last = over[14], before = 0, next;
#pragma GCC unroll 16
        for (int m = 13; m > 0; m--) next = over[m] + twice * last - square * before, before = last, last = next;
        cx x = re + im * I, tail = over[0] - square * before + x * last;
        cx f = .5 + x * (1. / 6 + x * tail), slope = 1. / 6 + x * (1. / 6 + (x - 2) * tail);
        cx g = 1 + x * f, decay = 1 + x * g, z = h * (g * v + f * c), w = h * h * ((f + x * slope) * v + slope * c);
        out[0][k] = creal(decay), out[1][k] = cimag(decay), out[2][k] = creal(z), out[3][k] = cimag(z);
        out[4][k] = creal(w), out[5][k] = cimag(w);
    }
}

/* Any clock, common to input and output, whose steps are shorter than every mode's memory. */
void irregular(const double *t, const double *u, const double *y, long samples, double delay, const cx *pole,
               const cx *residue, double *gram) {
    cx z[MODES] = {0}, w[MODES] = {0}, e[MODES] = {0};
    static double block[Q][BLOCK], breaks[3][BLOCK], late[3][BLOCK], output[3][BLOCK];
    static double b[MODES][6][BLOCK], r[MODES][6][BLOCK], o[MODES][6][BLOCK];
    int passed[BLOCK], count, reached;
    memset(gram, 0, sizeof(double) * Q * Q);
    for (long start = 0, j = -1; start < samples; start += count, j += reached) {
        for (count = reached = 0; count < BLOCK && start + count < samples; count++) {
            long k = start + count, i;
            while ((i = j + reached) + 1 < samples && t[i + 1] <= t[k] - delay) {
                if (reached == BLOCK) {
                    reached = passed[count - 1];
                    goto full;
                }
                breaks[0][reached] = i < 0 ? 0 : t[i + 1] - t[i], breaks[1][reached] = i < 0 ? 0 : u[i];
                reached++;
            }
            passed[count] = reached;
            late[0][count] = i < 0 ? 0 : t[k] - delay - t[i], late[1][count] = i < 0 ? 0 : u[i];
            output[0][count] = k ? t[k] - t[k - 1] : 0, output[1][count] = k ? y[k - 1] : 0;
            output[2][count] = k ? y[k] - y[k - 1] : 0;
        }
    full:
        for (int i = 0; i < MODES; i++) {
            steps(pole[i], reached, breaks, b[i]);
            steps(pole[i], count, late, r[i]);
            steps(pole[i], count, output, o[i]);
        }
        for (int k = 0, at = 0; k < count; k++) {
            cx zr[MODES], wr[MODES];
            for (int i = 0; i < MODES; i++) {
                for (int m = at; m < passed[k]; m++) {
                    cx d = b[i][0][m] + b[i][1][m] * I;
                    w[i] = d * (w[i] + breaks[0][m] * z[i]) + b[i][4][m] + b[i][5][m] * I;
                    z[i] = d * z[i] + b[i][2][m] + b[i][3][m] * I;
                }
                cx d = r[i][0][k] + r[i][1][k] * I;
                zr[i] = d * z[i] + r[i][2][k] + r[i][3][k] * I;
                wr[i] = d * (w[i] + late[0][k] * z[i]) + r[i][4][k] + r[i][5][k] * I;
                e[i] = (o[i][0][k] + o[i][1][k] * I) * e[i] + o[i][2][k] + o[i][3][k] * I;
            }
            at = passed[k];
            read_out(block, k, zr, wr, e, residue, late[1][k], y[start + k]);
        }
        moments(block, count, gram);
    }
}
