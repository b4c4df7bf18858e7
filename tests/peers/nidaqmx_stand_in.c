/* A stand-in for the C library of NI-DAQmx, which is National Instruments' and is not here.
 *
 * It has those functions of NIDAQmx.h that the package nidaqmx calls for huddle, and behaves as the
 * reference help says; whether the real library does, only hardware shows (docs/hardware-checks.md).
 * A chassis cDAQ1 holds two NI 9234, four inputs each. The acquisition runs on CLOCK_MONOTONIC. The
 * functions si_... are not NI's: a test overruns, stalls and unplugs the device by them.
 */
#include <pthread.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define MAX_CHANNELS 8
#define MAX_SEGMENTS 64
#define MASTER 51200.0
#define RANGE 5.0

enum {
    WRONG_DEVICE = -200220, WRONG_CHANNEL = -200170, WRONG_ATTRIBUTE = -200452, RESERVED = -50103,
    OVERWRITTEN = -200279, STOPPED = -200222, NOT_YET = -200284, UNPLUGGED = -201003, NO_RATE = -200077
};
enum { OVERWRITE = 10252, CURRENT_POSITION = 10425 };

typedef struct {
    int n_channels;
    char names[MAX_CHANNELS][32];
    int32_t coupling[MAX_CHANNELS], source[MAX_CHANNELS], terminal[MAX_CHANNELS], kind[MAX_CHANNELS];
    double excitation[MAX_CHANNELS];
    double rate;
    uint64_t buffer, position;
    int32_t offset, over_write;
    int is_started, is_dead;
} Task;

/* Stretches of time in which samples were taken: from the number `si_count` on, at `si_at`. */
int si_n_segments;
uint64_t si_count[MAX_SEGMENTS];
double si_at[MAX_SEGMENTS];
double si_gain = 1.0;
uint64_t si_buffer = UINT32_MAX; /* the most samples that a buffer holds */
Task *si_task; /* the last one */

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static int is_unplugged, is_held;
static double hangs;
static Task *owner;
static char said[256];
static const char *DEVICES[][2] = {{"cDAQ1", "cDAQ-9174"}, {"cDAQ1Mod1", "NI 9234"}, {"cDAQ1Mod2", "NI 9234"}};

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static void wait_for(double seconds) {
    struct timespec t = {(time_t)seconds, (long)(1e9 * (seconds - (time_t)seconds))};
    nanosleep(&t, NULL);
}

static int fails(int code, const char *text) {
    snprintf(said, sizeof said, "%s\n\nStatus Code: %d", text, code);
    return code;
}

static uint64_t acquired(const Task *task) {
    int last = si_n_segments - 1;
    if (!task->is_started || last < 0) return 0;
    if (is_held) return si_count[last];
    return si_count[last] + (uint64_t)((now() - si_at[last]) * task->rate);
}

static uint64_t buffer(const Task *task) {
    return task->buffer < si_buffer ? task->buffer : si_buffer;
}

static void begin(uint64_t count) {
    if (si_n_segments == MAX_SEGMENTS) abort();
    si_count[si_n_segments] = count;
    si_at[si_n_segments++] = now();
}

/* 24-bit converters: each sample of each input once. */
static double volts(uint64_t n, int channel) {
    int64_t code = (int64_t)((n * 7919 + channel * 104729 + 12345) % (1 << 23)) - (1 << 22);
    double v = RANGE * code / (1 << 23) * si_gain;
    return v > RANGE ? RANGE : v < -RANGE ? -RANGE : v;
}

/* ------------------------------------------------------------------ what tests do to the device */

void si_unplug(int now_unplugged) { is_unplugged = now_unplugged; }
void si_hang(double seconds) { hangs = seconds; } /* of the next read */

void si_hold(int hold) { /* an external sample clock pauses, never at the end of what was read */
    pthread_mutex_lock(&lock);
    uint64_t n = acquired(si_task), least = si_task->position + 100 * (hold != 0);
    begin(n < least ? least : n);
    is_held = hold;
    pthread_mutex_unlock(&lock);
}

uint64_t si_read(void) { return si_task ? si_task->position : 0; }

/* ------------------------------------------------------------------------------- NIDAQmx.h */

int DAQmxGetExtendedErrorInfo(char *text, uint32_t size) {
    snprintf(text, size, "%s", said);
    return 0;
}

int DAQmxGetErrorString(int code, char *text, uint32_t size) {
    snprintf(text, size, "%d", code);
    return 0;
}

static int string(const char *text, char *to, uint32_t size) {
    if (!size) return (int)strlen(text) + 1;
    snprintf(to, size, "%s", text);
    return 0;
}

int DAQmxGetSystemInfoAttribute(int attribute, ...) {
    va_list rest;
    va_start(rest, attribute);
    void *to = va_arg(rest, void *);
    int result = 0;
    if (attribute == 0x1272 || attribute == 0x1923 || attribute == 0x2f22) /* version 24.0.0 */
        *(uint32_t *)to = attribute == 0x1272 ? 24 : 0;
    else if (attribute == 0x193b)
        result = string(is_unplugged ? "" : "cDAQ1, cDAQ1Mod1, cDAQ1Mod2", to, va_arg(rest, uint32_t));
    else
        result = fails(WRONG_ATTRIBUTE, "no such attribute");
    va_end(rest);
    return result;
}

int DAQmxGetDeviceAttribute(const char *device, int attribute, ...) {
    int result = is_unplugged ? UNPLUGGED : WRONG_DEVICE;
    va_list rest;
    va_start(rest, attribute);
    void *to = va_arg(rest, void *);
    for (int k = 0; k < 3 && !is_unplugged; k++)
        if (!strcmp(device, DEVICES[k][0])) {
            if (attribute == 0x631) result = string(DEVICES[k][1], to, va_arg(rest, uint32_t));
            else if (attribute == 0x632) *(uint32_t *)to = 0x1A2B3C0 + k, result = 0;
            else result = WRONG_ATTRIBUTE;
        }
    va_end(rest);
    return result < 0 ? fails(result, "Device identifier is invalid.") : result;
}

int DAQmxCreateTask(const char *name, Task **made) {
    (void)name;
    *made = si_task = calloc(1, sizeof(Task));
    si_task->over_write = 10159;
    si_n_segments = is_held = 0;
    return 0;
}

int DAQmxGetTaskAttribute(Task *task, int attribute, ...) {
    va_list rest;
    va_start(rest, attribute);
    char *to = va_arg(rest, char *);
    int result = attribute == 0x1276 ? string("_unnamedTask<0>", to, va_arg(rest, uint32_t))
                                     : fails(WRONG_ATTRIBUTE, "no such attribute");
    va_end(rest);
    (void)task;
    return result;
}

int DAQmxCreateAIVoltageChan(Task *task, const char *physical, const char *name, int terminal,
                             double low, double high, int units, const char *scale) {
    (void)name, (void)low, (void)units, (void)scale;
    char module, input, rest;
    if (is_unplugged) return fails(WRONG_DEVICE, "Device identifier is invalid.");
    if (sscanf(physical, "cDAQ1Mod%c/ai%c%c", &module, &input, &rest) != 2 || module < '1' ||
        module > '2' || input < '0' || input > '3')
        return fails(strncmp(physical, "cDAQ1Mod", 8) ? WRONG_DEVICE : WRONG_CHANNEL,
                     "Physical channel specified does not exist on this device.");
    if (high > RANGE) return fails(NO_RATE, "Requested value is not a supported value: AI.Max.");
    int k = task->n_channels++;
    snprintf(task->names[k], sizeof task->names[k], "%s", physical);
    task->terminal[k] = terminal;
    return 0;
}

static int channel(const Task *task, const char *name) {
    for (int k = 0; k < task->n_channels; k++)
        if (!strcmp(task->names[k], name)) return k;
    return -1;
}

int DAQmxGetChanAttribute(Task *task, const char *name, int attribute, ...) {
    int k = channel(task, name), result = 0;
    va_list rest;
    va_start(rest, attribute);
    void *to = va_arg(rest, void *);
    if (k < 0) result = fails(WRONG_CHANNEL, "no such channel");
    else if (attribute == 0x1815) *(double *)to = RANGE;
    else if (attribute == 0x17f5) *(double *)to = task->excitation[k];
    else if (attribute == 0x64) *(int32_t *)to = task->coupling[k];
    else if (attribute == 0x17f4) *(int32_t *)to = task->source[k];
    else if (attribute == 0x17f6) *(int32_t *)to = task->kind[k];
    else if (attribute == 0x1097) *(int32_t *)to = task->terminal[k];
    else result = fails(WRONG_ATTRIBUTE, "no such attribute");
    va_end(rest);
    return result;
}

int DAQmxSetChanAttribute(Task *task, const char *name, int attribute, ...) {
    int k = channel(task, name), result = 0;
    va_list rest;
    va_start(rest, attribute);
    if (k < 0) result = fails(WRONG_CHANNEL, "no such channel");
    else if (attribute == 0x17f5) task->excitation[k] = va_arg(rest, double);
    else if (attribute == 0x64) task->coupling[k] = va_arg(rest, int32_t);
    else if (attribute == 0x17f4) task->source[k] = va_arg(rest, int32_t);
    else if (attribute == 0x17f6) task->kind[k] = va_arg(rest, int32_t);
    else result = fails(WRONG_ATTRIBUTE, "no such attribute");
    va_end(rest);
    return result;
}

int DAQmxCfgSampClkTiming(Task *task, const char *source, double rate, int edge, int mode, uint64_t n) {
    (void)source, (void)edge, (void)mode;
    int divisor = (int)(MASTER / rate + 1e-9); /* to the next higher rate that there is */
    if (divisor < 1) return fails(NO_RATE, "Requested value is not a supported value: SampClk.Rate.");
    task->rate = MASTER / (divisor > 31 ? 31 : divisor);
    task->buffer = n;
    return 0;
}

int DAQmxGetTimingAttribute(Task *task, int attribute, ...) {
    va_list rest;
    va_start(rest, attribute);
    if (attribute == 0x1344) *va_arg(rest, double *) = task->rate;
    va_end(rest);
    return attribute == 0x1344 ? 0 : fails(WRONG_ATTRIBUTE, "no such attribute");
}

int DAQmxGetBufferAttribute(Task *task, int attribute, ...) {
    va_list rest;
    va_start(rest, attribute);
    if (attribute == 0x186c) *va_arg(rest, uint32_t *) = (uint32_t)buffer(task);
    va_end(rest);
    return attribute == 0x186c ? 0 : fails(WRONG_ATTRIBUTE, "no such attribute");
}

int DAQmxGetReadAttribute(Task *task, int attribute, ...) {
    va_list rest;
    va_start(rest, attribute);
    void *to = va_arg(rest, void *);
    int result = 0;
    pthread_mutex_lock(&lock);
    if (attribute == 0x1221) *(uint64_t *)to = task->position;
    else if (attribute == 0x192a) *(uint64_t *)to = acquired(task);
    else if (attribute == 0x217b) *(uint32_t *)to = task->n_channels;
    else result = fails(WRONG_ATTRIBUTE, "no such attribute");
    pthread_mutex_unlock(&lock);
    va_end(rest);
    return result;
}

int DAQmxSetReadAttribute(Task *task, int attribute, ...) {
    va_list rest;
    va_start(rest, attribute);
    int32_t value = va_arg(rest, int32_t);
    va_end(rest);
    if (attribute == 0x190b) task->offset = value;
    else if (attribute == 0x1211) task->over_write = value;
    else if (attribute != 0x190a || value != CURRENT_POSITION)
        return fails(WRONG_ATTRIBUTE, "no such attribute");
    return 0;
}

int DAQmxStartTask(Task *task) {
    if (is_unplugged) return fails(UNPLUGGED, "Device cannot be accessed.");
    if (owner && owner != task) return fails(RESERVED, "The specified resource is reserved.");
    pthread_mutex_lock(&lock);
    owner = task;
    task->is_started = 1;
    begin(0);
    pthread_mutex_unlock(&lock);
    return 0;
}

int DAQmxStopTask(Task *task) {
    task->is_started = 0;
    if (owner == task) owner = NULL;
    return is_unplugged ? fails(UNPLUGGED, "Device cannot be accessed.") : 0;
}

int DAQmxClearTask(Task *task) {
    if (owner == task) owner = NULL; /* si_task is kept for tests */
    return 0;
}

int DAQmxReadAnalogF64(Task *task, int32_t n, double timeout, int fill, double *to, uint32_t size,
                       int32_t *n_read, void *reserved) {
    (void)fill, (void)reserved; /* by channel */
    *n_read = 0;
    if ((uint64_t)n * task->n_channels > size) return fails(-200229, "The buffer is too small.");
    if (hangs > 0) {
        double seconds = hangs;
        hangs = 0;
        wait_for(seconds);
    }
    double deadline = now() + timeout;
    for (;;) {
        pthread_mutex_lock(&lock);
        uint64_t from = task->position + task->offset, there = acquired(task);
        int code = 0;
        if (is_unplugged) code = fails(UNPLUGGED, "Device cannot be accessed. Possible causes: Device"
                                                  " is no longer present in the system.");
        else if (task->is_dead || there > from + buffer(task)) {
            task->is_dead = task->over_write != OVERWRITE;
            code = task->is_dead ? fails(STOPPED, "Acquisition has been stopped.")
                                 : fails(OVERWRITTEN, "Attempted to read samples that are no longer available.");
        } else if (there >= from + n || now() >= deadline) {
            if (there < from + n) code = fails(NOT_YET, "Some or all of the samples requested have not yet been acquired.");
            uint64_t have = there < from ? 0 : there - from;
            *n_read = have < (uint64_t)n ? (int32_t)have : n;
            for (int c = 0; c < task->n_channels; c++) {
                int input = 4 * (task->names[c][8] - '1') + task->names[c][12] - '0';
                for (int k = 0; k < *n_read; k++) to[c * n + k] = volts(from + k, input);
            }
            task->position = from + *n_read;
        } else {
            pthread_mutex_unlock(&lock);
            wait_for(0.001);
            continue;
        }
        pthread_mutex_unlock(&lock);
        return code;
    }
}
