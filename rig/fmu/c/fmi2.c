/* The functions of FMI 2.0 (Functional Mock-up Interface Specification 2.0.4), for Model Exchange and
   Co-Simulation. */
#include "model.h"

#include "fmi2.h"

#include <string.h>

#include "component.h"

#define EXPORTED(result, name) FMI2_EXPORT result FMI2(name)

typedef struct {
    Component component;
    const fmi2CallbackFunctions *functions;
    fmi2Boolean is_logging;
    double last_step_s; /* end of the last step that succeeded */
    char name[128];
} Instance;

static void report(void *to, const char *category, const char *message) {
    const Instance *m = to;
    const fmi2CallbackFunctions *f = m->functions;
    if (m->is_logging && f->logger)
        f->logger(f->componentEnvironment, m->name, fmi2Error, category, "%s", message);
}

static fmi2Status status(Instance *m, int succeeded) {
    (void)m;
    return succeeded ? fmi2OK : fmi2Error;
}

/* The instance, if it may be asked now. */
#define ENTER(phases)                                                            \
    Instance *m = c;                                                             \
    if (!m || !component_allows(&m->component, (phases), __func__)) return fmi2Error

EXPORTED(const char *, fmi2GetTypesPlatform)(void) { return "default"; }

EXPORTED(const char *, fmi2GetVersion)(void) { return "2.0"; }

EXPORTED(fmi2Component, fmi2Instantiate)(
    fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
    const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean is_logging) {
    Instance *m;
    (void)resources;
    (void)visible;
    if (!functions || !functions->allocateMemory || !functions->freeMemory) return NULL;
    if (!guid || strcmp(guid, MODEL_TOKEN) != 0 || !name || !*name) {
        if (functions->logger)
            functions->logger(functions->componentEnvironment, name ? name : "", fmi2Error,
                              "logStatusError",
                              "name and GUID: expected a name, and " MODEL_TOKEN);
        return NULL;
    }
    m = functions->allocateMemory(1, sizeof *m);
    if (!m) return NULL;
    memset(m, 0, sizeof *m);
    m->functions = functions;
    m->is_logging = is_logging;
    strncpy(m->name, name, sizeof m->name - 1);
    m->component.is_co_simulation = type == fmi2CoSimulation;
    m->component.log = report;
    m->component.to = m;
    component_reset(&m->component);
    return m;
}

EXPORTED(void, fmi2FreeInstance)(fmi2Component c) {
    Instance *m = c;
    if (m) m->functions->freeMemory(m);
}

EXPORTED(fmi2Status, fmi2SetDebugLogging)(fmi2Component c, fmi2Boolean is_logging, size_t count,
                                          const fmi2String categories[]) {
    ENTER(ANY_PHASE);
    (void)count;
    (void)categories;
    m->is_logging = is_logging;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SetupExperiment)(fmi2Component c, fmi2Boolean has_tolerance,
                                          fmi2Real tolerance, fmi2Real start_s,
                                          fmi2Boolean has_stop, fmi2Real stop_s) {
    ENTER(INSTANTIATED);
    (void)has_tolerance;
    (void)tolerance;
    (void)has_stop;
    (void)stop_s;
    component_set_time(&m->component, start_s);
    m->last_step_s = start_s;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2EnterInitializationMode)(fmi2Component c) {
    ENTER(INSTANTIATED);
    m->component.now.phase = INITIALIZATION;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2ExitInitializationMode)(fmi2Component c) {
    ENTER(INITIALIZATION);
    if (!component_update(&m->component)) return fmi2Error;
    m->component.now.phase = m->component.is_co_simulation ? STEP : EVENT;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2Terminate)(fmi2Component c) {
    ENTER(EVENT | CONTINUOUS_TIME | STEP);
    m->component.now.phase = TERMINATED;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2Reset)(fmi2Component c) {
    ENTER(ANY_PHASE);
    component_reset(&m->component);
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2GetReal)(fmi2Component c, const fmi2ValueReference references[],
                                  size_t count, fmi2Real values[]) {
    size_t i;
    ENTER(ANY_PHASE);
    for (i = 0; i < count; ++i)
        if (!component_get(&m->component, references[i], &values[i])) return fmi2Error;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SetReal)(fmi2Component c, const fmi2ValueReference references[],
                                  size_t count, const fmi2Real values[]) {
    size_t i;
    ENTER(ANY_PHASE);
    for (i = 0; i < count; ++i) {
        if (!component_may_set(&m->component, references[i])) {
            component_log(&m->component, "value reference %u: may not be set now", references[i]);
            return fmi2Error;
        }
        component_set(&m->component, references[i], values[i]);
    }
    return fmi2OK;
}

/* There are values of no other type. */
#define NO_VALUES(type)                                                                       \
    EXPORTED(fmi2Status, fmi2Get##type)(fmi2Component c, const fmi2ValueReference references[], \
                                        size_t count, fmi2##type values[]) {                  \
        ENTER(ANY_PHASE);                                                                     \
        (void)references;                                                                     \
        (void)values;                                                                         \
        return status(m, count == 0);                                                         \
    }                                                                                         \
    EXPORTED(fmi2Status, fmi2Set##type)(fmi2Component c, const fmi2ValueReference references[], \
                                        size_t count, const fmi2##type values[]) {            \
        ENTER(ANY_PHASE);                                                                     \
        (void)references;                                                                     \
        (void)values;                                                                         \
        return status(m, count == 0);                                                         \
    }

NO_VALUES(Integer)
NO_VALUES(Boolean)
NO_VALUES(String)

EXPORTED(fmi2Status, fmi2GetFMUstate)(fmi2Component c, fmi2FMUstate *state) {
    ENTER(ANY_PHASE);
    if (!*state) *state = m->functions->allocateMemory(1, sizeof(State));
    if (!*state) return fmi2Error;
    memcpy(*state, &m->component.now, sizeof(State));
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SetFMUstate)(fmi2Component c, fmi2FMUstate state) {
    ENTER(ANY_PHASE);
    if (!state) return fmi2Error;
    memcpy(&m->component.now, state, sizeof(State));
    m->last_step_s = m->component.now.value[0];
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2FreeFMUstate)(fmi2Component c, fmi2FMUstate *state) {
    ENTER(ANY_PHASE);
    if (state && *state) {
        m->functions->freeMemory(*state);
        *state = NULL;
    }
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SerializedFMUstateSize)(fmi2Component c, fmi2FMUstate state,
                                                 size_t *size) {
    ENTER(ANY_PHASE);
    (void)state;
    *size = sizeof(State);
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SerializeFMUstate)(fmi2Component c, fmi2FMUstate state,
                                            fmi2Byte bytes[], size_t size) {
    ENTER(ANY_PHASE);
    if (!state || size < sizeof(State)) return fmi2Error;
    memcpy(bytes, state, sizeof(State));
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2DeSerializeFMUstate)(fmi2Component c, const fmi2Byte bytes[],
                                              size_t size, fmi2FMUstate *state) {
    ENTER(ANY_PHASE);
    if (size != sizeof(State)) return fmi2Error;
    if (!*state) *state = m->functions->allocateMemory(1, sizeof(State));
    if (!*state) return fmi2Error;
    memcpy(*state, bytes, sizeof(State));
    return fmi2OK;
}

/* Said in the description: there are no directional derivatives. */
EXPORTED(fmi2Status, fmi2GetDirectionalDerivative)(
    fmi2Component c, const fmi2ValueReference unknowns[], size_t unknown_count,
    const fmi2ValueReference knowns[], size_t known_count, const fmi2Real seeds[],
    fmi2Real sensitivities[]) {
    ENTER(ANY_PHASE);
    (void)unknowns;
    (void)unknown_count;
    (void)knowns;
    (void)known_count;
    (void)seeds;
    (void)sensitivities;
    component_log(&m->component, "fmi2GetDirectionalDerivative: not provided");
    return fmi2Error;
}

/* Model Exchange */

EXPORTED(fmi2Status, fmi2EnterEventMode)(fmi2Component c) {
    ENTER(CONTINUOUS_TIME | EVENT);
    m->component.now.phase = EVENT;
    m->component.now.is_stale = 1; /* the switches are free now */
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2NewDiscreteStates)(fmi2Component c, fmi2EventInfo *info) {
    ENTER(EVENT);
    memset(info, 0, sizeof *info);
    return status(m, component_update(&m->component));
}

EXPORTED(fmi2Status, fmi2EnterContinuousTimeMode)(fmi2Component c) {
    ENTER(EVENT);
    if (!component_update(&m->component)) return fmi2Error;
    m->component.now.phase = CONTINUOUS_TIME;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2CompletedIntegratorStep)(fmi2Component c, fmi2Boolean is_final,
                                                  fmi2Boolean *wants_event,
                                                  fmi2Boolean *wants_end) {
    ENTER(CONTINUOUS_TIME);
    (void)is_final;
    *wants_event = fmi2False;
    *wants_end = fmi2False;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SetTime)(fmi2Component c, fmi2Real t_s) {
    ENTER(EVENT | CONTINUOUS_TIME);
    component_set_time(&m->component, t_s);
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2SetContinuousStates)(fmi2Component c, const fmi2Real states[],
                                              size_t count) {
    ENTER(CONTINUOUS_TIME);
    if (count != STATES) return fmi2Error;
    memcpy(m->component.now.value + FIRST_STATE, states, count * sizeof *states);
    m->component.now.is_stale = 1;
    return fmi2OK;
}

/* A number of values one after another, up to date. */
static fmi2Status copied(Instance *m, fmi2Real out[], size_t count, size_t expected, int first) {
    if (count != expected) return fmi2Error;
    if (!component_update(&m->component)) return fmi2Discard;
    memcpy(out, m->component.now.value + first, count * sizeof *out);
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2GetDerivatives)(fmi2Component c, fmi2Real rates[], size_t count) {
    ENTER(RUNNING | TERMINATED);
    return copied(m, rates, count, STATES, FIRST_RATE);
}

EXPORTED(fmi2Status, fmi2GetEventIndicators)(fmi2Component c, fmi2Real indicators[],
                                             size_t count) {
    ENTER(RUNNING | TERMINATED);
    return copied(m, indicators, count, SWITCHES, FIRST_INDICATOR);
}

EXPORTED(fmi2Status, fmi2GetContinuousStates)(fmi2Component c, fmi2Real states[], size_t count) {
    ENTER(RUNNING | TERMINATED);
    return copied(m, states, count, STATES, FIRST_STATE);
}

EXPORTED(fmi2Status, fmi2GetNominalsOfContinuousStates)(fmi2Component c, fmi2Real nominals[],
                                                        size_t count) {
    ENTER(ANY_PHASE);
    if (count != STATES) return fmi2Error;
    memcpy(nominals, model_nominals, count * sizeof *nominals);
    return status(m, 1);
}

/* Co-Simulation */

EXPORTED(fmi2Status, fmi2SetRealInputDerivatives)(
    fmi2Component c, const fmi2ValueReference references[], size_t count,
    const fmi2Integer orders[], const fmi2Real values[]) {
    size_t i;
    ENTER(INSTANTIATED | INITIALIZATION | STEP);
    for (i = 0; i < count; ++i) {
        const fmi2ValueReference input = references[i] - FIRST_INPUT;
        if (references[i] < FIRST_INPUT || input >= INPUTS || orders[i] != 1) return fmi2Error;
        m->component.now.input_rate[input] = values[i];
    }
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2GetRealOutputDerivatives)(
    fmi2Component c, const fmi2ValueReference references[], size_t count,
    const fmi2Integer orders[], fmi2Real values[]) {
    ENTER(ANY_PHASE);
    (void)references;
    (void)orders;
    (void)values;
    return status(m, count == 0);
}

EXPORTED(fmi2Status, fmi2DoStep)(fmi2Component c, fmi2Real t_s, fmi2Real step_s,
                                 fmi2Boolean keeps_no_state) {
    ENTER(STEP);
    (void)keeps_no_state;
    if (!(step_s >= 0.0)) {
        component_log(&m->component, "fmi2DoStep: step of %g s: expected a positive one", step_s);
        return fmi2Error;
    }
    component_set_time(&m->component, t_s);
    if (!component_advance(&m->component, step_s)) {
        component_log(&m->component, "fmi2DoStep at %g s: a state is not finite", t_s);
        m->component.now.phase = FAILED;
        return fmi2Error;
    }
    m->last_step_s = m->component.now.value[0];
    return fmi2OK;
}

/* Steps end before fmi2DoStep returns: there is nothing to cancel, and nothing is pending. */
EXPORTED(fmi2Status, fmi2CancelStep)(fmi2Component c) {
    ENTER(ANY_PHASE);
    return status(m, 0);
}

EXPORTED(fmi2Status, fmi2GetStatus)(fmi2Component c, const fmi2StatusKind kind,
                                    fmi2Status *value) {
    ENTER(ANY_PHASE);
    if (kind != fmi2DoStepStatus) return fmi2Discard;
    *value = m->component.now.phase == FAILED ? fmi2Error : fmi2OK;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2GetRealStatus)(fmi2Component c, const fmi2StatusKind kind,
                                        fmi2Real *value) {
    ENTER(ANY_PHASE);
    if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
    *value = m->last_step_s;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2GetIntegerStatus)(fmi2Component c, const fmi2StatusKind kind,
                                           fmi2Integer *value) {
    ENTER(ANY_PHASE);
    (void)kind;
    (void)value;
    return fmi2Discard;
}

EXPORTED(fmi2Status, fmi2GetBooleanStatus)(fmi2Component c, const fmi2StatusKind kind,
                                           fmi2Boolean *value) {
    ENTER(ANY_PHASE);
    if (kind != fmi2Terminated) return fmi2Discard;
    *value = fmi2False;
    return fmi2OK;
}

EXPORTED(fmi2Status, fmi2GetStringStatus)(fmi2Component c, const fmi2StatusKind kind,
                                          fmi2String *value) {
    ENTER(ANY_PHASE);
    if (kind != fmi2PendingStatus) return fmi2Discard;
    *value = "";
    return fmi2OK;
}
