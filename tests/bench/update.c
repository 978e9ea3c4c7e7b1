/* One update of the whole organ as a plain C loop: a ball against a round tube, the surface by
   regions (hermite), and the dent of 16 centres. The skeleton is that of sweep.c. */

#include <math.h>

/* Signed distance of a ball and a row of capsules along x; where on the axis, and round it. */
void contact(int patches, const double *border, double overlap, double tube, const double *ball,
             double radius, double *gap, double *s, double *phi) {
    double away = hypot(ball[1], ball[2]), best = INFINITY;
    for (int i = 0; i < patches; i++) {
        double low = border[i] - overlap, high = border[i + 1] + overlap;
        double beyond = fmax(fmax(low - ball[0], ball[0] - high), 0);
        double d = hypot(beyond, away) - radius - tube;
        if (d < best) best = d;
    }
    *gap = best;
    *s = ball[0];
    *phi = atan2(ball[2], ball[1]);
}

/* Rows of `keys` are nodes: J (3), U (3), V (3), slope (2); C is one more node of the J line. */
void surface(int n, int nodes, const double *node, const int *patch, const double *fraction,
             const double *s, const double *weight, const double *keys, double s_c,
             const double *contact, int centres, const double *centre, const double *dent,
             double reach, const double *rest, double *out) {
    double poly[32][3][4], start[32], inverse[32], ends[32][6], rise[32][6];
    int below = 0;
    while (below < nodes - 2 && node[below + 1] <= s_c) below++;
    for (int p = 0; p < nodes; p++) {
        const double *a = p <= below ? keys + 11 * p : p == below + 1 ? contact : keys + 11 * (p - 1);
        const double *b = p < below ? keys + 11 * (p + 1) : p == below ? contact : keys + 11 * p;
        double x = p <= below ? node[p] : p == below + 1 ? s_c : node[p - 1];
        double y = p < below ? node[p + 1] : p == below ? s_c : node[p], h = y - x;
        start[p] = x;
        inverse[p] = h > 0 ? 1 / h : 0;
        for (int c = 0; c < 3; c++) {
            double d = b[c] - a[c], l = c ? h * a[8 + c] : d, r = c ? h * b[8 + c] : d;
            poly[p][c][0] = a[c];
            poly[p][c][1] = l;
            poly[p][c][2] = 3 * d - 2 * l - r;
            poly[p][c][3] = l + r - 2 * d;
        }
    }
    for (int p = 0; p < nodes - 1; p++)
        for (int c = 0; c < 6; c++) {
            ends[p][c] = keys[11 * p + 3 + c];
            rise[p][c] = keys[11 * (p + 1) + 3 + c] - ends[p][c];
        }
    double scale = 1 / (reach * reach);
    for (int i = 0; i < n; i++) {
        int p = patch[i], q = p + (s[i] >= s_c);
        double t = (s[i] - start[q]) * inverse[q], f = fraction[i];
        const double *x = rest + 3 * i, *w = weight + 3 * i;
        double u[3];
        for (int c = 0; c < 3; c++) {
            const double *k = poly[q][c];
            double J = k[0] + t * (k[1] + t * (k[2] + t * k[3]));
            u[c] = w[0] * (ends[p][c] + f * rise[p][c]) + w[1] * J
                 + w[2] * (ends[p][3 + c] + f * rise[p][3 + c]);
        }
        for (int j = 0; j < centres; j++) {
            double a = x[0] - centre[3 * j], b = x[1] - centre[3 * j + 1];
            double d = x[2] - centre[3 * j + 2], r = (a * a + b * b + d * d) * scale;
            if (r < 1) {
                double v = sqrt(r), z = 1 - v, k = z * z * z * z * (4 * v + 1);
                for (int c = 0; c < 3; c++) u[c] += k * dent[3 * j + c];
            }
        }
        for (int c = 0; c < 3; c++) out[3 * i + c] = x[c] + u[c];
    }
}

/* A of n <= 32 rows is factored in place, three right-hand sides are solved. */
static void cholesky(int n, double A[32][32], double b[32][3]) {
    for (int i = 0; i < n; i++) {
        for (int j = 0; j <= i; j++) {
            double v = A[i][j];
            for (int k = 0; k < j; k++) v -= A[i][k] * A[j][k];
            A[i][j] = i == j ? sqrt(v) : v / A[j][j];
        }
        for (int c = 0; c < 3; c++) {
            double v = b[i][c];
            for (int k = 0; k < i; k++) v -= A[i][k] * b[k][c];
            b[i][c] = v / A[i][i];
        }
    }
    for (int i = n - 1; i >= 0; i--)
        for (int c = 0; c < 3; c++) {
            double v = b[i][c];
            for (int k = i + 1; k < n; k++) v -= A[k][i] * b[k][c];
            b[i][c] = v / A[i][i];
        }
}

static double wendland(double square) {
    if (square >= 1) return 0;
    double q = sqrt(square), z = 1 - q;
    return z * z * z * z * (4 * q + 1);
}

void values(int, int, const double *, double, const double *, const double *, const double *,
            const double *, double *, double *, double *, double *);

typedef struct {
    int vertices, rings, patches, centres;
    double length, tube, radius, k_1, k_3, spacing;
    const double *x, *node, *EI, *k, *border, *fraction, *s, *weight, *rest, *offset;
    const int *patch, *collar;
} Scene;

/* A normal press in the anterior midline: force out, vertices into `out`. */
double update(const Scene *g, const double *ball, double *out) {
    double gap, s, phi, one = 1, tip[4], w[30], theta[30], R[30], keys[32 * 11], C[11];
    contact(g->patches, g->border, 0.5, g->tube, ball, g->radius, &gap, &s, &phi);
    values(1, g->rings, g->x, g->length, g->EI, g->k, &s, &one, tip, w, theta, R);
    double D = gap < 0 ? -gap : 0, d = D;
    for (int i = 0; i < 50 && D > 0; i++) { /* d + c (k_1 + k_3 d^2) d = D */
        double f = d + tip[0] * (g->k_1 + g->k_3 * d * d) * d - D;
        double step = f / (1 + tip[0] * (g->k_1 + 3 * g->k_3 * d * d));
        d -= step;
        if (fabs(step) < 1e-15 * D) break;
    }
    double F = (g->k_1 + g->k_3 * d * d) * d;
    for (int i = 0; i < 11 * (g->rings + 2); i++) keys[i] = 0;
    for (int i = 0; i < g->rings; i++) {
        double *row = keys + 11 * (i + 1);
        row[1] = row[4] = row[7] = -F * w[i];
        row[9] = -F * theta[i];
    }
    for (int i = 0; i < 11; i++) C[i] = 0;
    C[1] = -F * tip[0];
    C[9] = -F * tip[1];
    double centre[32][3], A[32][32], dent[32][3], reach = 3 * g->spacing;
    double away = g->tube;
    for (int j = 0; j < g->centres; j++) {
        double turn = phi + g->offset[2 * j + 1] * g->spacing / away;
        centre[j][0] = s + g->offset[2 * j] * g->spacing;
        centre[j][1] = away * cos(turn);
        centre[j][2] = away * sin(turn);
    }
    for (int i = 0; i < g->centres; i++) {
        for (int j = 0; j <= i; j++) {
            double square = 0;
            for (int c = 0; c < 3; c++) square += pow(centre[i][c] - centre[j][c], 2);
            A[i][j] = wendland(square / (reach * reach));
        }
        A[i][i] += 16 * g->centres * 2.220446049250313e-16;
        double off = 0, level = away + g->radius;
        off += pow(centre[i][0] - s, 2) + pow(centre[i][1] - level * cos(phi), 2);
        off = sqrt(off + pow(centre[i][2] - level * sin(phi), 2)) - g->radius;
        double share = d > 0 ? fmax(1 - fmax(off, 0) / d, 0) : 0;
        if (i == 0) share = 1;
        if (g->collar[i]) share = 0;
        for (int c = 0; c < 3; c++) dent[i][c] = c == 1 ? -d * share : 0;
    }
    if (g->centres) cholesky(g->centres, A, dent);
    surface(g->vertices, g->rings + 2, g->node, g->patch, g->fraction, g->s, g->weight, keys, s, C,
            g->centres, &centre[0][0], &dent[0][0], reach, g->rest, out);
    return F;
}
