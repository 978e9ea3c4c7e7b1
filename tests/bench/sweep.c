/* The force-method sweep of jaxtrachea.mechanics.beam (continuous split) as a plain scalar C loop.

   Compliance recursion from both clamps to C, 2x2 joint, back substitution to every ring: the same
   inputs and outputs as `deflect`, all read and written for every lane. The gradient needs no tape:
   the beam is self-adjoint, so dw_C/dk_i = -w_i^2 / F, dw_C/dEI = -int M^2 dx / (EI^2 F) and
   dw_C/ds_c = 2 theta_C. */

#define MAX 1024

typedef struct { double a, b, c; } Tip;

static inline Tip span(Tip g, double h, double EI) {
    double f = h / EI;
    Tip r = {g.a + h * (2 * g.b + h * (g.c + f / 3)), g.b + h * (g.c + f / 2), g.c + f};
    return r;
}

typedef struct { Tip after[MAX]; double h[MAX + 1], k[MAX], passed[MAX]; int n; Tip tip; } Side;

static inline void forward(Side *s, double last, double last_EI, const double *EI, int step) {
    Tip g = {0, 0, 0};
    for (int i = 0; i < s->n; i++) {
        g = span(g, s->h[i], EI[i * step]);
        double q = 1 / (1 + s->k[i] * g.a);
        g.c -= s->k[i] * q * g.b * g.b;
        g.a *= q;
        g.b *= q;
        s->passed[i] = q;
        s->after[i] = g;
    }
    s->h[s->n] = last;
    s->tip = span(g, last, last_EI);
}

/* Moment at the far end of every span goes to M (for the gradient), if asked. */
static inline void backward(const Side *s, double V, double M, double sign, int step, double *w,
                            double *theta, double *R, double (*ends)[2]) {
    for (int i = s->n - 1; i >= 0; i--) {
        double at_tip = M;
        M += s->h[i + 1] * V;
        if (ends) { ends[i + 1][0] = at_tip; ends[i + 1][1] = M; }
        Tip g = s->after[i];
        w[i * step] = g.a * V + g.b * M;
        theta[i * step] = sign * (g.b * V + g.c * M);
        R[i * step] = s->k[i] * w[i * step];
        V = s->passed[i] * V - s->k[i] * g.b * M;
    }
    if (ends) { ends[0][0] = M; ends[0][1] = M + s->h[0] * V; }
}

static void solve(int n, const double *x, double L, const double *EI, const double *k, double s_c,
                  double F, double *tip, double *w, double *theta, double *R, double *dk,
                  double *dEI) {
    static Side A, B;
    double ends_A[MAX + 1][2], ends_B[MAX + 1][2];
    int count = 0;
    while (count < n && x[count] <= s_c) count++;
    A.n = count;
    B.n = n - count;
    for (int i = 0; i < A.n; i++) { A.h[i] = x[i] - (i ? x[i - 1] : 0); A.k[i] = k[i]; }
    for (int i = 0; i < B.n; i++) {
        B.h[i] = (i ? x[n - i] : L) - x[n - 1 - i];
        B.k[i] = k[n - 1 - i];
    }
    forward(&A, s_c - (count ? x[count - 1] : 0), EI[count], EI, 1);
    forward(&B, (count < n ? x[count] : L) - s_c, EI[count], EI + n, -1);
    Tip a = A.tip, b = B.tip;
    /* (G_A + S G_B S) (V_A, M) = F S G_B S e_1, S = diag(1, -1) */
    double p = a.a + b.a, q = a.b - b.b, r = a.c + b.c, det = p * r - q * q;
    double V = F * (r * b.a + q * b.b) / det, M = F * (-p * b.b - q * b.a) / det;
    tip[0] = a.a * V + a.b * M;
    tip[1] = a.b * V + a.c * M;
    tip[2] = V;
    tip[3] = M;
    backward(&A, V, M, 1, 1, w, theta, R, dk ? ends_A : 0);
    backward(&B, F - V, M, -1, -1, w + n - 1, theta + n - 1, R + n - 1, dk ? ends_B : 0);
    if (!dk) return;
    for (int i = 0; i < n; i++) dk[i] = -w[i] * w[i] / F;
    for (int i = 0; i <= n; i++) dEI[i] = 0;
    for (int i = 0; i <= A.n; i++) {
        double u = ends_A[i][0], v = ends_A[i][1];
        dEI[i] -= A.h[i] / 3 * (u * u + u * v + v * v) / (EI[i] * EI[i] * F);
    }
    for (int i = 0; i <= B.n; i++) {
        double u = ends_B[i][0], v = ends_B[i][1], e = EI[n - i];
        dEI[n - i] -= B.h[i] / 3 * (u * u + u * v + v * v) / (e * e * F);
    }
}

/* lanes problems on the same rings; tip: w_C, theta_C, force_A, moment_A of each. */
void values(int lanes, int n, const double *x, double L, const double *EI, const double *k,
            const double *s_c, const double *F, double *tip, double *w, double *theta, double *R) {
    for (int j = 0; j < lanes; j++)
        solve(n, x, L, EI + j * (n + 1), k + j * n, s_c[j], F[j], tip + 4 * j, w + j * n,
              theta + j * n, R + j * n, 0, 0);
}

/* w_C and its derivatives with respect to k, EI and s_c. */
void gradients(int lanes, int n, const double *x, double L, const double *EI, const double *k,
               const double *s_c, const double *F, double *w_C, double *dk, double *dEI,
               double *ds) {
    double tip[4], w[MAX], theta[MAX], R[MAX];
    for (int j = 0; j < lanes; j++) {
        solve(n, x, L, EI + j * (n + 1), k + j * n, s_c[j], F[j], tip, w, theta, R, dk + j * n,
              dEI + j * (n + 1));
        w_C[j] = tip[0];
        ds[j] = 2 * tip[1];
    }
}
