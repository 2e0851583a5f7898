/* Where a law switches: the answer of each comparison, which a solver may hold while it steps. */
#ifndef SWITCHES_H
#define SWITCHES_H

#include <math.h>

/* Half the width of a switch that is held, in the unit of what it compares (m, m/s, N or none): it
   turns this far behind the place where it compares. Without a width, rounding at a place of rest
   would turn it for ever. A nanometre, or a nanometre a second, is below what any bench resolves. */
#define SWITCH_WIDTH 1e-9

typedef struct {
    int is_held;       /* whether answers stay as they were */
    long *answer;      /* the answer of every switch */
    double *indicator; /* what changes its sign where one has to turn */
} Switches;

/* The difference, bounded: a solver that looks for a root interpolates, and must meet no infinity. */
static inline double bounded(double difference) {
    if (!(difference < 1e6)) return 1e6;
    return difference > -1e6 ? difference : -1e6;
}

static inline int turned(const Switches *s, int k, double difference, int now) {
    if (!s->is_held) s->answer[k] = now;
    s->indicator[k] = bounded(difference) + (s->answer[k] ? SWITCH_WIDTH : -SWITCH_WIDTH);
    return s->answer[k] != 0;
}

static inline int is_less(const Switches *s, int k, double a, double b) {
    return turned(s, k, b - a, a < b);
}

static inline int is_at_most(const Switches *s, int k, double a, double b) {
    return turned(s, k, b - a, a <= b);
}

static inline int is_more(const Switches *s, int k, double a, double b) {
    return turned(s, k, a - b, a > b);
}

static inline int is_at_least(const Switches *s, int k, double a, double b) {
    return turned(s, k, a - b, a >= b);
}

/* Of equals the first one, as Python has it. */
static inline double larger(const Switches *s, int k, double a, double b) {
    return turned(s, k, b - a, b > a) ? b : a;
}

static inline double smaller(const Switches *s, int k, double a, double b) {
    return turned(s, k, a - b, b < a) ? b : a;
}

static inline double magnitude(const Switches *s, int k, double a) {
    return turned(s, k, -a, a < 0.0) ? -a : a;
}

static inline double signed_as(const Switches *s, int k, double size, double sign) {
    return turned(s, k, -sign, signbit(sign) != 0) ? -fabs(size) : fabs(size);
}

/* Python's int(): truncates. The indicator is positive within an even cell, negative within an odd
   one, so that it passes zero from each cell to the next. */
static inline long whole_part(const Switches *s, int k, double a) {
    if (!s->is_held) s->answer[k] = fabs(a) < 1e9 ? (long)a : 0;
    const double cell = (double)s->answer[k];
    const double inside = SWITCH_WIDTH + fmin(a - cell, cell + 1.0 - a);
    s->indicator[k] = s->answer[k] % 2 ? -bounded(inside) : bounded(inside);
    return s->answer[k];
}

/* A held switch lets an argument run a little out of where its function has a value. */
static inline double root(double a) { return sqrt(a > 0.0 ? a : 0.0); }

static inline double power(double base, double exponent) {
    return pow(base < 0.0 && exponent != floor(exponent) ? 0.0 : base, exponent);
}

#endif
