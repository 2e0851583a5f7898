/* The functions of FMI 3.0 (Functional Mock-up Interface Specification 3.0.2), for Model Exchange and
   Co-Simulation. Of what the description says that there is none of (values that are not Float64,
   clocks, derivatives, partitions) the functions are there and return an error. */
#include "model.h"

#include "fmi3.h"

#include <stdlib.h>
#include <string.h>

#include "component.h"

#define EXPORTED(result, name) FMI3_EXPORT result FMI3(name)

typedef struct {
    Component component;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
    fmi3Boolean is_logging;
} Instance;

static void report(void *to, const char *category, const char *message) {
    const Instance *m = to;
    if (m->is_logging && m->log) m->log(m->environment, fmi3Error, category, message);
}

/* The instance, if it may be asked now. */
#define ENTER(phases)                                                            \
    Instance *m = c;                                                             \
    if (!m || !component_allows(&m->component, (phases), __func__)) return fmi3Error

EXPORTED(const char *, fmi3GetVersion)(void) { return "3.0"; }

static Instance *instantiated(fmi3String name, fmi3String token, fmi3Boolean is_logging,
                              fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                              int is_co_simulation) {
    Instance *m;
    if (!name || !*name || !token || strcmp(token, MODEL_TOKEN) != 0) {
        if (log)
            log(environment, fmi3Error, "logStatusError",
                "name and token: expected a name, and " MODEL_TOKEN);
        return NULL;
    }
    m = calloc(1, sizeof *m);
    if (!m) return NULL;
    m->log = log;
    m->environment = environment;
    m->is_logging = is_logging;
    m->component.is_co_simulation = is_co_simulation;
    m->component.log = report;
    m->component.to = m;
    component_reset(&m->component);
    return m;
}

EXPORTED(fmi3Instance, fmi3InstantiateModelExchange)(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean is_logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    (void)resources;
    (void)visible;
    return instantiated(name, token, is_logging, environment, log, 0);
}

EXPORTED(fmi3Instance, fmi3InstantiateCoSimulation)(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean is_logging, fmi3Boolean uses_events, fmi3Boolean allows_early_return,
    const fmi3ValueReference intermediate[], size_t intermediate_count,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3IntermediateUpdateCallback update) {
    (void)resources;
    (void)visible;
    (void)uses_events;
    (void)allows_early_return;
    (void)intermediate;
    (void)intermediate_count;
    (void)update;
    return instantiated(name, token, is_logging, environment, log, 1);
}

EXPORTED(fmi3Instance, fmi3InstantiateScheduledExecution)(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean is_logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
    fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock,
    fmi3UnlockPreemptionCallback unlock) {
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)is_logging;
    (void)update;
    (void)lock;
    (void)unlock;
    if (log) log(environment, fmi3Error, "logStatusError", "scheduled execution: not provided");
    return NULL;
}

EXPORTED(void, fmi3FreeInstance)(fmi3Instance c) { free(c); }

EXPORTED(fmi3Status, fmi3SetDebugLogging)(fmi3Instance c, fmi3Boolean is_logging, size_t count,
                                          const fmi3String categories[]) {
    ENTER(ANY_PHASE);
    (void)count;
    (void)categories;
    m->is_logging = is_logging;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3EnterInitializationMode)(fmi3Instance c, fmi3Boolean has_tolerance,
                                                  fmi3Float64 tolerance, fmi3Float64 start_s,
                                                  fmi3Boolean has_stop, fmi3Float64 stop_s) {
    ENTER(INSTANTIATED);
    (void)has_tolerance;
    (void)tolerance;
    (void)has_stop;
    (void)stop_s;
    component_set_time(&m->component, start_s);
    m->component.now.phase = INITIALIZATION;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3ExitInitializationMode)(fmi3Instance c) {
    ENTER(INITIALIZATION);
    if (!component_update(&m->component)) return fmi3Error;
    m->component.now.phase = m->component.is_co_simulation ? STEP : EVENT;
    return fmi3OK;
}

/* Co-Simulation has no event mode, as the description says: it steps over its events by itself. */
EXPORTED(fmi3Status, fmi3EnterEventMode)(fmi3Instance c) {
    ENTER(CONTINUOUS_TIME | EVENT);
    m->component.now.phase = EVENT;
    m->component.now.is_stale = 1; /* the switches are free now */
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3EnterStepMode)(fmi3Instance c) {
    ENTER(STEP);
    component_log(&m->component, "fmi3EnterStepMode: there is no event mode to come from");
    return fmi3Error;
}

EXPORTED(fmi3Status, fmi3Terminate)(fmi3Instance c) {
    ENTER(EVENT | CONTINUOUS_TIME | STEP);
    m->component.now.phase = TERMINATED;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3Reset)(fmi3Instance c) {
    ENTER(ANY_PHASE);
    component_reset(&m->component);
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3GetFloat64)(fmi3Instance c, const fmi3ValueReference references[],
                                     size_t count, fmi3Float64 values[], size_t value_count) {
    size_t i;
    ENTER(ANY_PHASE);
    if (count != value_count) return fmi3Error;
    for (i = 0; i < count; ++i)
        if (!component_get(&m->component, references[i], &values[i])) return fmi3Error;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3SetFloat64)(fmi3Instance c, const fmi3ValueReference references[],
                                     size_t count, const fmi3Float64 values[],
                                     size_t value_count) {
    size_t i;
    ENTER(ANY_PHASE);
    if (count != value_count) return fmi3Error;
    for (i = 0; i < count; ++i) {
        if (!component_may_set(&m->component, references[i])) {
            component_log(&m->component, "value reference %u: may not be set now",
                          (unsigned)references[i]);
            return fmi3Error;
        }
        component_set(&m->component, references[i], values[i]);
    }
    return fmi3OK;
}

/* What there is none of: nothing of it can be asked for. */
static fmi3Status none_of(fmi3Instance c, size_t count, const char *function) {
    Instance *m = c;
    if (!m || !component_allows(&m->component, ANY_PHASE, function)) return fmi3Error;
    if (count == 0) return fmi3OK;
    component_log(&m->component, "%s: there is nothing of this kind", function);
    return fmi3Error;
}

#define NO_VALUES(type)                                                                           \
    EXPORTED(fmi3Status, fmi3Get##type)(fmi3Instance c, const fmi3ValueReference references[],    \
                                        size_t count, fmi3##type values[], size_t value_count) {  \
        (void)references;                                                                         \
        (void)values;                                                                             \
        (void)value_count;                                                                        \
        return none_of(c, count, __func__);                                                       \
    }                                                                                             \
    EXPORTED(fmi3Status, fmi3Set##type)(fmi3Instance c, const fmi3ValueReference references[],    \
                                        size_t count, const fmi3##type values[],                  \
                                        size_t value_count) {                                     \
        (void)references;                                                                         \
        (void)values;                                                                             \
        (void)value_count;                                                                        \
        return none_of(c, count, __func__);                                                       \
    }

NO_VALUES(Float32)
NO_VALUES(Int8)
NO_VALUES(UInt8)
NO_VALUES(Int16)
NO_VALUES(UInt16)
NO_VALUES(Int32)
NO_VALUES(UInt32)
NO_VALUES(Int64)
NO_VALUES(UInt64)
NO_VALUES(Boolean)
NO_VALUES(String)

EXPORTED(fmi3Status, fmi3GetBinary)(fmi3Instance c, const fmi3ValueReference references[],
                                    size_t count, size_t sizes[], fmi3Binary values[],
                                    size_t value_count) {
    (void)references;
    (void)sizes;
    (void)values;
    (void)value_count;
    return none_of(c, count, __func__);
}

EXPORTED(fmi3Status, fmi3SetBinary)(fmi3Instance c, const fmi3ValueReference references[],
                                    size_t count, const size_t sizes[], const fmi3Binary values[],
                                    size_t value_count) {
    (void)references;
    (void)sizes;
    (void)values;
    (void)value_count;
    return none_of(c, count, __func__);
}

EXPORTED(fmi3Status, fmi3GetClock)(fmi3Instance c, const fmi3ValueReference references[],
                                   size_t count, fmi3Clock values[]) {
    (void)references;
    (void)values;
    return none_of(c, count, __func__);
}

EXPORTED(fmi3Status, fmi3SetClock)(fmi3Instance c, const fmi3ValueReference references[],
                                   size_t count, const fmi3Clock values[]) {
    (void)references;
    (void)values;
    return none_of(c, count, __func__);
}

EXPORTED(fmi3Status, fmi3GetNumberOfVariableDependencies)(fmi3Instance c,
                                                          fmi3ValueReference reference,
                                                          size_t *count) {
    (void)reference;
    (void)count;
    return none_of(c, 1, __func__);
}

EXPORTED(fmi3Status, fmi3GetVariableDependencies)(
    fmi3Instance c, fmi3ValueReference dependent, size_t elements_of_dependent[],
    fmi3ValueReference independents[], size_t elements_of_independents[],
    fmi3DependencyKind kinds[], size_t count) {
    (void)dependent;
    (void)elements_of_dependent;
    (void)independents;
    (void)elements_of_independents;
    (void)kinds;
    (void)count;
    return none_of(c, 1, __func__);
}

EXPORTED(fmi3Status, fmi3GetFMUState)(fmi3Instance c, fmi3FMUState *state) {
    ENTER(ANY_PHASE);
    if (!*state) *state = malloc(sizeof(State));
    if (!*state) return fmi3Error;
    memcpy(*state, &m->component.now, sizeof(State));
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3SetFMUState)(fmi3Instance c, fmi3FMUState state) {
    ENTER(ANY_PHASE);
    if (!state) return fmi3Error;
    memcpy(&m->component.now, state, sizeof(State));
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3FreeFMUState)(fmi3Instance c, fmi3FMUState *state) {
    ENTER(ANY_PHASE);
    if (state && *state) {
        free(*state);
        *state = NULL;
    }
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3SerializedFMUStateSize)(fmi3Instance c, fmi3FMUState state,
                                                 size_t *size) {
    ENTER(ANY_PHASE);
    (void)state;
    *size = sizeof(State);
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3SerializeFMUState)(fmi3Instance c, fmi3FMUState state,
                                            fmi3Byte bytes[], size_t size) {
    ENTER(ANY_PHASE);
    if (!state || size < sizeof(State)) return fmi3Error;
    memcpy(bytes, state, sizeof(State));
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3DeserializeFMUState)(fmi3Instance c, const fmi3Byte bytes[],
                                              size_t size, fmi3FMUState *state) {
    ENTER(ANY_PHASE);
    if (size != sizeof(State)) return fmi3Error;
    if (!*state) *state = malloc(sizeof(State));
    if (!*state) return fmi3Error;
    memcpy(*state, bytes, sizeof(State));
    return fmi3OK;
}

#define NO_DERIVATIVE(name)                                                                  \
    EXPORTED(fmi3Status, name)(fmi3Instance c, const fmi3ValueReference unknowns[],          \
                               size_t unknown_count, const fmi3ValueReference knowns[],      \
                               size_t known_count, const fmi3Float64 seed[],                 \
                               size_t seed_count, fmi3Float64 sensitivity[],                 \
                               size_t sensitivity_count) {                                   \
        (void)unknowns;                                                                      \
        (void)unknown_count;                                                                 \
        (void)knowns;                                                                        \
        (void)known_count;                                                                   \
        (void)seed;                                                                          \
        (void)seed_count;                                                                    \
        (void)sensitivity;                                                                   \
        (void)sensitivity_count;                                                             \
        return none_of(c, 1, __func__);                                                      \
    }

NO_DERIVATIVE(fmi3GetDirectionalDerivative)
NO_DERIVATIVE(fmi3GetAdjointDerivative)

/* There are no structural parameters to configure. */
EXPORTED(fmi3Status, fmi3EnterConfigurationMode)(fmi3Instance c) {
    return none_of(c, 1, __func__);
}

EXPORTED(fmi3Status, fmi3ExitConfigurationMode)(fmi3Instance c) { return none_of(c, 1, __func__); }

EXPORTED(fmi3Status, fmi3GetIntervalDecimal)(fmi3Instance c,
                                             const fmi3ValueReference references[], size_t count,
                                             fmi3Float64 intervals[],
                                             fmi3IntervalQualifier qualifiers[]) {
    (void)references;
    (void)intervals;
    (void)qualifiers;
    return none_of(c, count, __func__);
}

EXPORTED(fmi3Status, fmi3GetIntervalFraction)(fmi3Instance c,
                                              const fmi3ValueReference references[], size_t count,
                                              fmi3UInt64 counters[], fmi3UInt64 resolutions[],
                                              fmi3IntervalQualifier qualifiers[]) {
    (void)references;
    (void)counters;
    (void)resolutions;
    (void)qualifiers;
    return none_of(c, count, __func__);
}

#define NO_DECIMAL(name, qualifier)                                                       \
    EXPORTED(fmi3Status, name)(fmi3Instance c, const fmi3ValueReference references[],     \
                               size_t count, qualifier fmi3Float64 values[]) {            \
        (void)references;                                                                 \
        (void)values;                                                                     \
        return none_of(c, count, __func__);                                               \
    }

#define NO_FRACTION(name, qualifier)                                                      \
    EXPORTED(fmi3Status, name)(fmi3Instance c, const fmi3ValueReference references[],     \
                               size_t count, qualifier fmi3UInt64 counters[],             \
                               qualifier fmi3UInt64 resolutions[]) {                      \
        (void)references;                                                                 \
        (void)counters;                                                                   \
        (void)resolutions;                                                                \
        return none_of(c, count, __func__);                                               \
    }

NO_DECIMAL(fmi3GetShiftDecimal, )
NO_DECIMAL(fmi3SetShiftDecimal, const)
NO_DECIMAL(fmi3SetIntervalDecimal, const)
NO_FRACTION(fmi3GetShiftFraction, )
NO_FRACTION(fmi3SetShiftFraction, const)
NO_FRACTION(fmi3SetIntervalFraction, const)

EXPORTED(fmi3Status, fmi3EvaluateDiscreteStates)(fmi3Instance c) {
    ENTER(INITIALIZATION | EVENT);
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3UpdateDiscreteStates)(fmi3Instance c, fmi3Boolean *needs_update,
                                               fmi3Boolean *wants_end,
                                               fmi3Boolean *nominals_changed,
                                               fmi3Boolean *states_changed,
                                               fmi3Boolean *has_next_event,
                                               fmi3Float64 *next_event_s) {
    ENTER(EVENT);
    *needs_update = false;
    *wants_end = false;
    *nominals_changed = false;
    *states_changed = false;
    *has_next_event = false;
    *next_event_s = 0.0;
    return component_update(&m->component) ? fmi3OK : fmi3Error;
}

/* Model Exchange */

EXPORTED(fmi3Status, fmi3EnterContinuousTimeMode)(fmi3Instance c) {
    ENTER(EVENT);
    if (!component_update(&m->component)) return fmi3Error;
    m->component.now.phase = CONTINUOUS_TIME;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3CompletedIntegratorStep)(fmi3Instance c, fmi3Boolean is_final,
                                                  fmi3Boolean *wants_event,
                                                  fmi3Boolean *wants_end) {
    ENTER(CONTINUOUS_TIME);
    (void)is_final;
    *wants_event = false;
    *wants_end = false;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3SetTime)(fmi3Instance c, fmi3Float64 t_s) {
    ENTER(EVENT | CONTINUOUS_TIME);
    component_set_time(&m->component, t_s);
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3SetContinuousStates)(fmi3Instance c, const fmi3Float64 states[],
                                              size_t count) {
    ENTER(CONTINUOUS_TIME);
    if (count != STATES) return fmi3Error;
    memcpy(m->component.now.value + FIRST_STATE, states, count * sizeof *states);
    m->component.now.is_stale = 1;
    return fmi3OK;
}

/* A number of values one after another, up to date. */
static fmi3Status copied(Instance *m, fmi3Float64 out[], size_t count, size_t expected,
                         int first) {
    if (count != expected) return fmi3Error;
    if (!component_update(&m->component)) return fmi3Discard;
    memcpy(out, m->component.now.value + first, count * sizeof *out);
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3GetContinuousStateDerivatives)(fmi3Instance c, fmi3Float64 rates[],
                                                        size_t count) {
    ENTER(RUNNING | TERMINATED);
    return copied(m, rates, count, STATES, FIRST_RATE);
}

EXPORTED(fmi3Status, fmi3GetEventIndicators)(fmi3Instance c, fmi3Float64 indicators[],
                                             size_t count) {
    ENTER(RUNNING | TERMINATED);
    return copied(m, indicators, count, SWITCHES, FIRST_INDICATOR);
}

EXPORTED(fmi3Status, fmi3GetContinuousStates)(fmi3Instance c, fmi3Float64 states[],
                                              size_t count) {
    ENTER(RUNNING | TERMINATED);
    return copied(m, states, count, STATES, FIRST_STATE);
}

EXPORTED(fmi3Status, fmi3GetNominalsOfContinuousStates)(fmi3Instance c, fmi3Float64 nominals[],
                                                        size_t count) {
    ENTER(ANY_PHASE);
    if (count != STATES) return fmi3Error;
    memcpy(nominals, model_nominals, count * sizeof *nominals);
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3GetNumberOfEventIndicators)(fmi3Instance c, size_t *count) {
    ENTER(ANY_PHASE);
    *count = SWITCHES;
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3GetNumberOfContinuousStates)(fmi3Instance c, size_t *count) {
    ENTER(ANY_PHASE);
    *count = STATES;
    return fmi3OK;
}

/* Co-Simulation */

EXPORTED(fmi3Status, fmi3GetOutputDerivatives)(fmi3Instance c,
                                               const fmi3ValueReference references[],
                                               size_t count, const fmi3Int32 orders[],
                                               fmi3Float64 values[], size_t value_count) {
    (void)references;
    (void)orders;
    (void)values;
    (void)value_count;
    return none_of(c, count, __func__);
}

EXPORTED(fmi3Status, fmi3DoStep)(fmi3Instance c, fmi3Float64 t_s, fmi3Float64 step_s,
                                 fmi3Boolean keeps_no_state, fmi3Boolean *needs_event,
                                 fmi3Boolean *wants_end, fmi3Boolean *is_early,
                                 fmi3Float64 *last_s) {
    ENTER(STEP);
    (void)keeps_no_state;
    *needs_event = false;
    *wants_end = false;
    *is_early = false;
    *last_s = t_s;
    if (!(step_s > 0.0)) {
        component_log(&m->component, "fmi3DoStep: step of %g s: expected a positive one", step_s);
        return fmi3Error;
    }
    component_set_time(&m->component, t_s);
    if (!component_advance(&m->component, step_s)) {
        component_log(&m->component, "fmi3DoStep at %g s: a state is not finite", t_s);
        m->component.now.phase = FAILED;
        return fmi3Error;
    }
    *last_s = m->component.now.value[0];
    return fmi3OK;
}

EXPORTED(fmi3Status, fmi3ActivateModelPartition)(fmi3Instance c, fmi3ValueReference clock,
                                                 fmi3Float64 t_s) {
    (void)clock;
    (void)t_s;
    return none_of(c, 1, __func__);
}
