/* What both versions of the interface share: the values of a model, and its phases. */
#ifndef COMPONENT_H
#define COMPONENT_H

#include <stddef.h>

#include "model.h"

/* Phases of an instance, as bits, so that a function can name all in which it may be called. */
enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT = 4,
    CONTINUOUS_TIME = 8,
    STEP = 16,
    TERMINATED = 32,
    FAILED = 64,
    ANY_PHASE = 127,
    RUNNING = INITIALIZATION | EVENT | CONTINUOUS_TIME | STEP,
    READABLE = RUNNING | TERMINATED | FAILED
};

/* All that a state of the instance consists of: a copy of it is a snapshot. `value` holds time,
   inputs, parameters, states and what follows from them, one after another (see model.h). */
typedef struct {
    int phase;
    int is_stale;                   /* whether what follows from the values has to be computed */
    long answer[SWITCHES + 1];      /* of every switch */
    double value[VALUES];
    double input_rate[INPUTS + 1];  /* for steps of co-simulation: slopes of the inputs */
} State;

typedef struct {
    State now;
    int is_co_simulation;
    void (*log)(void *to, const char *category, const char *message);
    void *to;
} Component;

/* Set all to their start values. */
void component_reset(Component *c);

/* Compute what follows from the values, where that is stale. Returns 0 if something is not finite. */
int component_update(Component *c);

/* Value `reference`, up to date. Returns 0 if there is none, or it is not finite. */
int component_get(Component *c, unsigned reference, double *value);

/* Whether value `reference` may be set in this phase. */
int component_may_set(const Component *c, unsigned reference);

void component_set(Component *c, unsigned reference, double value);

void component_set_time(Component *c, double t_s);

/* Advance by a duration in s in equal steps of Kutta's method. Returns 0 if a state is not finite. */
int component_advance(Component *c, double duration_s);

/* Whether the instance is in one of `phases`; says so in the log where it is not. */
int component_allows(Component *c, int phases, const char *function);

void component_log(Component *c, const char *format, ...);

#endif
