/* The same of FMI 3.0. */
#include <stdio.h>
#include <stdlib.h>
#include <windows.h>

#include "fmi3.h"

static void log_message(fmi3InstanceEnvironment e, fmi3Status status, fmi3String category,
                        fmi3String message) {
    (void)e, (void)status, (void)category;
    fprintf(stderr, "%s\n", message);
}

#define LOOK_UP(result, name, ...)                                                  \
    result (*name)(__VA_ARGS__) = (result(*)(__VA_ARGS__))(void *)GetProcAddress(library, #name); \
    if (!name) return fprintf(stderr, "no " #name "\n"), 2

#define MUST(call) \
    if ((call) != fmi3OK) return fprintf(stderr, #call " refused\n"), 3

int main(int count, char **given) {
    HMODULE library = LoadLibraryA(given[1]);
    fmi3ValueReference place;
    double value, step_s, last_s;
    bool needs_event, wants_end, is_early;
    int k, steps;
    fmi3Instance it;
    if (count != 7 || !library) return fprintf(stderr, "not loaded\n"), 1;
    place = (fmi3ValueReference)atoi(given[3]);
    value = atof(given[4]);
    steps = atoi(given[5]);
    step_s = atof(given[6]);
    LOOK_UP(fmi3Instance, fmi3InstantiateCoSimulation, fmi3String, fmi3String, fmi3String, bool, bool,
            bool, bool, const fmi3ValueReference *, size_t, fmi3InstanceEnvironment,
            fmi3LogMessageCallback, fmi3IntermediateUpdateCallback);
    LOOK_UP(fmi3Status, fmi3EnterInitializationMode, fmi3Instance, bool, double, double, bool, double);
    LOOK_UP(fmi3Status, fmi3ExitInitializationMode, fmi3Instance);
    LOOK_UP(fmi3Status, fmi3SetFloat64, fmi3Instance, const fmi3ValueReference *, size_t,
            const double *, size_t);
    LOOK_UP(fmi3Status, fmi3GetFloat64, fmi3Instance, const fmi3ValueReference *, size_t, double *,
            size_t);
    LOOK_UP(fmi3Status, fmi3DoStep, fmi3Instance, double, double, bool, bool *, bool *, bool *,
            double *);
    LOOK_UP(fmi3Status, fmi3Terminate, fmi3Instance);
    LOOK_UP(void, fmi3FreeInstance, fmi3Instance);
    it = fmi3InstantiateCoSimulation("it", given[2], "", 0, 1, 0, 0, NULL, 0, NULL, log_message, NULL);
    if (!it) return 4;
    MUST(fmi3EnterInitializationMode(it, 0, 0.0, 0.0, 0, 0.0));
    MUST(fmi3SetFloat64(it, &place, 1, &value, 1));
    MUST(fmi3ExitInitializationMode(it));
    for (k = 0; k < steps; ++k) {
        MUST(fmi3DoStep(it, k * step_s, step_s, 1, &needs_event, &wants_end, &is_early, &last_s));
        MUST(fmi3GetFloat64(it, &place, 1, &value, 1));
        printf("%.17g\n", value);
    }
    MUST(fmi3Terminate(it));
    fmi3FreeInstance(it);
    return 0;
}
