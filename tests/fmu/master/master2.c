/* A master that loads an FMU of FMI 2.0 by its file and steps it: what a program on Windows does.
   Arguments: library, token, reference of a state, its value, steps, step (s). Prints the state. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <windows.h>

#include "fmi2.h"

static void log_message(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status,
                        fmi2String category, fmi2String message, ...) {
    va_list rest;
    (void)e, (void)name, (void)status, (void)category;
    va_start(rest, message);
    vfprintf(stderr, message, rest);
    va_end(rest);
}

#define LOOK_UP(result, name, ...)                                                  \
    result (*name)(__VA_ARGS__) = (result(*)(__VA_ARGS__))(void *)GetProcAddress(library, #name); \
    if (!name) return fprintf(stderr, "no " #name "\n"), 2

#define MUST(call) \
    if ((call) != fmi2OK) return fprintf(stderr, #call " refused\n"), 3

int main(int count, char **given) {
    static const fmi2CallbackFunctions functions = {log_message, calloc, free, NULL, NULL};
    HMODULE library = LoadLibraryA(given[1]);
    fmi2ValueReference place;
    double value, step_s;
    int k, steps;
    fmi2Component it;
    if (count != 7 || !library) return fprintf(stderr, "not loaded\n"), 1;
    place = (fmi2ValueReference)atoi(given[3]);
    value = atof(given[4]);
    steps = atoi(given[5]);
    step_s = atof(given[6]);
    LOOK_UP(fmi2Component, fmi2Instantiate, fmi2String, fmi2Type, fmi2String, fmi2String,
            const fmi2CallbackFunctions *, fmi2Boolean, fmi2Boolean);
    LOOK_UP(fmi2Status, fmi2SetupExperiment, fmi2Component, fmi2Boolean, double, double, fmi2Boolean,
            double);
    LOOK_UP(fmi2Status, fmi2EnterInitializationMode, fmi2Component);
    LOOK_UP(fmi2Status, fmi2ExitInitializationMode, fmi2Component);
    LOOK_UP(fmi2Status, fmi2SetReal, fmi2Component, const fmi2ValueReference *, size_t,
            const double *);
    LOOK_UP(fmi2Status, fmi2GetReal, fmi2Component, const fmi2ValueReference *, size_t, double *);
    LOOK_UP(fmi2Status, fmi2DoStep, fmi2Component, double, double, fmi2Boolean);
    LOOK_UP(fmi2Status, fmi2Terminate, fmi2Component);
    LOOK_UP(void, fmi2FreeInstance, fmi2Component);
    it = fmi2Instantiate("it", fmi2CoSimulation, given[2], "", &functions, 0, 1);
    if (!it) return 4;
    MUST(fmi2SetupExperiment(it, 0, 0.0, 0.0, 0, 0.0));
    MUST(fmi2SetReal(it, &place, 1, &value));
    MUST(fmi2EnterInitializationMode(it));
    MUST(fmi2ExitInitializationMode(it));
    for (k = 0; k < steps; ++k) {
        MUST(fmi2DoStep(it, k * step_s, step_s, 1));
        MUST(fmi2GetReal(it, &place, 1, &value));
        printf("%.17g\n", value);
    }
    MUST(fmi2Terminate(it));
    fmi2FreeInstance(it);
    return 0;
}
