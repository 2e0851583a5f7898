#include "component.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#define MOST_STEPS 1000000.0

void component_reset(Component *c) {
    memset(&c->now, 0, sizeof c->now);
    c->now.phase = INSTANTIATED;
    c->now.is_stale = 1;
    memcpy(c->now.value, model_start, sizeof model_start);
}

/* Between events a solver of model exchange sees no switch turn; everywhere else they are free. */
static int is_held(const Component *c) { return c->now.phase == CONTINUOUS_TIME; }

static int are_finite(const double *values, int count) {
    int i;
    for (i = 0; i < count; ++i)
        if (!isfinite(values[i])) return 0;
    return 1;
}

int component_update(Component *c) {
    if (!c->now.is_stale) return 1;
    model_evaluate(c->now.value, c->now.answer, is_held(c));
    if (!are_finite(c->now.value + FIRST_RATE, STATES + OUTPUTS)) {
        component_log(c, "t = %g s: a force or a rate is not finite", c->now.value[0]);
        return 0;
    }
    c->now.is_stale = 0;
    return 1;
}

int component_get(Component *c, unsigned reference, double *value) {
    if (reference >= VALUES) {
        component_log(c, "value reference %u: expected one below %d", reference, VALUES);
        return 0;
    }
    if (reference >= FIRST_RATE && c->now.phase != INSTANTIATED && !component_update(c)) return 0;
    *value = c->now.value[reference];
    return 1;
}

int component_may_set(const Component *c, unsigned reference) {
    const int before = INSTANTIATED | INITIALIZATION;
    int phases = 0;
    if (reference >= FIRST_INPUT && reference < FIRST_INPUT + INPUTS)
        phases = INSTANTIATED | RUNNING;
    else if (reference >= FIRST_PARAMETER && reference < FIRST_PARAMETER + PARAMETERS)
        phases = before | EVENT | STEP;
    else if (reference >= FIRST_FIXED && reference < FIRST_FIXED + FIXED)
        phases = before;
    else if (reference >= FIRST_STATE && reference < FIRST_STATE + STATES)
        phases = before;
    return (c->now.phase & phases) != 0;
}

void component_set(Component *c, unsigned reference, double value) {
    c->now.value[reference] = value;
    c->now.is_stale = 1;
}

void component_set_time(Component *c, double t_s) {
    if (c->now.value[0] == t_s) return;
    c->now.value[0] = t_s;
    c->now.is_stale = 1;
}

/* Put states and inputs of a stage, and evaluate there. */
static void evaluate_at(Component *c, double t_s, double since_s, const double *inputs,
                        const double *states, const double *rates_a, double a,
                        const double *rates_b, double b) {
    double *value = c->now.value;
    int i;
    value[0] = t_s;
    for (i = 0; i < INPUTS; ++i)
        value[FIRST_INPUT + i] = inputs[i] + c->now.input_rate[i] * since_s;
    for (i = 0; i < STATES; ++i) value[FIRST_STATE + i] = states[i] + a * rates_a[i] + b * rates_b[i];
    model_evaluate(value, c->now.answer, 0);
}

int component_advance(Component *c, double duration_s) {
    const double begin_s = c->now.value[0];
    const double longest_s = c->now.value[LONGEST_STEP];
    double inputs[INPUTS + 1] = {0}, states[STATES + 1] = {0};
    double one[STATES + 1] = {0}, two[STATES + 1] = {0}, none[STATES + 1] = {0};
    double *value = c->now.value;
    double count = ceil(duration_s / longest_s * (1.0 - 1e-9)), step;
    int i;
    if (!(count >= 1.0)) count = 1.0;
    if (count > MOST_STEPS) count = MOST_STEPS;
    const double h = duration_s / count;
    memcpy(inputs, value + FIRST_INPUT, INPUTS * sizeof *inputs);
    for (step = 0.0; STATES > 0 && step < count; step += 1.0) {
        const double since_s = step * h, t_s = begin_s + since_s;
        memcpy(states, value + FIRST_STATE, STATES * sizeof *states);
        evaluate_at(c, t_s, since_s, inputs, states, none, 0.0, none, 0.0);
        memcpy(one, value + FIRST_RATE, STATES * sizeof *one);
        evaluate_at(c, t_s + 0.5 * h, since_s + 0.5 * h, inputs, states, one, 0.5 * h, none, 0.0);
        memcpy(two, value + FIRST_RATE, STATES * sizeof *two);
        evaluate_at(c, t_s + h, since_s + h, inputs, states, two, 2.0 * h, one, -h);
        for (i = 0; i < STATES; ++i)
            value[FIRST_STATE + i] =
                states[i] + h * ((one[i] + 4.0 * two[i] + value[FIRST_RATE + i]) / 6.0);
    }
    value[0] = begin_s + duration_s;
    for (i = 0; i < INPUTS; ++i) {
        value[FIRST_INPUT + i] = inputs[i] + c->now.input_rate[i] * duration_s;
        c->now.input_rate[i] = 0.0;
    }
    c->now.is_stale = 1;
    return are_finite(value + FIRST_STATE, STATES);
}

int component_allows(Component *c, int phases, const char *function) {
    if (c == NULL) return 0;
    if (c->now.phase & phases) return 1;
    component_log(c, "%s: not allowed in this phase", function);
    return 0;
}

void component_log(Component *c, const char *format, ...) {
    char message[256];
    va_list arguments;
    if (c->log == NULL) return;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    c->log(c->to, "logStatusError", message);
}
