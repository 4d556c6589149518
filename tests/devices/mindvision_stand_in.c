/* Stands in for MindVision's library (libMVSDK.so): one camera, no time. What a test wants to go wrong is set with stand_in_set().

A frame is there at once, unless a test says otherwise: nothing here waits. Pixel 0 of an image is the number of its exposure (mod 256), pixel 1 tells
the exposure time in ms, and the rest rises from left to right, by one more from row to row. */

#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define SUCCESS 0
#define NOT_SUPPORTED (-4)
#define OUT_OF_BOUND (-7)
#define TIME_OUT (-12)
#define LOST_DATA (-26)
#define DEVICE_LOST (-38)
#define ACCESS_DENY (-45)

typedef struct {
    char series[32], product[32], friendly[32], link[32], driver[32], sensor[32], port[32], serial[32];
    uint32_t instance;
} DeviceInfo;

typedef struct {
    int32_t index;
    char description[32];
    uint32_t bin_sum, bin_average, skip, resample;
    int32_t x, y, width_fov, height_fov, width, height, zoom[4];
} Resolution;

typedef struct { /* lists and their lengths as the vendor's header has them, one after the other */
    void *triggers_list;
    int32_t triggers;
    void *resolutions_list;
    int32_t resolutions;
    void *temperatures_list;
    int32_t temperatures;
    void *media_list;
    int32_t media;
    void *speeds_list;
    int32_t speeds;
    void *packets_list;
    int32_t packets;
    int32_t outputs, inputs;
    void *look_up_list;
    int32_t look_up;
    int32_t user_data, parameters_in_device;
    void *ae_sw_list;
    int32_t ae_sw;
    void *ae_hd_list;
    int32_t ae_hd;
    void *bayer_sw_list;
    int32_t bayer_sw;
    void *bayer_hd_list;
    int32_t bayer_hd;
    uint32_t target_min, target_max, gain_min, gain_max;
    float gain_step;
    uint32_t lines_min, lines_max;
    int32_t height_max, height_min, width_max, width_min;
    uint32_t skip, bin_sum, bin_average, resample;
    int32_t rgb_gain[6], saturation[2], gamma[2], contrast[2], sharpness[2];
    int32_t mono, wb_once, auto_wb, auto_exposure, manual_exposure, anti_flicker, isp, isp_only, zoom;
} Capability;

typedef struct {
    uint32_t media_type, bytes;
    int32_t width, height, width_zoom, height_zoom, triggered;
    uint32_t time_stamp, exposure_us;
    float gain;
    int32_t gamma, contrast, saturation;
    float red, green, blue;
} FrameHead;

typedef struct {
    int32_t total, captured, lost;
} Statistic;

/* what a test sets */
static int cameras, silent, colour, triggers, held, unplugged, lose, damage, late, auto_stays, no_sharpness, every_second_waits, fail_gain;
/* what the camera is doing */
static int is_open, plays, mode, pending, gain, auto_exposure, exposures, lost, releases_missing, calls, gamma_now, contrast_now, mirrored;
static uint32_t out_format;
static double exposure_us;
static Resolution resolution;
static uint8_t raw[64 * 48];

void stand_in_reset(void) {
    cameras = 1, silent = colour = 0, triggers = 3, held = unplugged = lose = damage = late = auto_stays = no_sharpness = 0;
    every_second_waits = fail_gain = 0;
    is_open = plays = mode = pending = exposures = lost = releases_missing = calls = 0;
    gain = 8, auto_exposure = 1, exposure_us = 10000, gamma_now = contrast_now = 50, mirrored = 1;
    memset(&resolution, 0, sizeof resolution);
}

static struct {
    const char *name;
    int *value;
} values[] = {
    {"cameras", &cameras}, {"colour", &colour}, {"silent", &silent}, {"triggers", &triggers}, {"held", &held}, {"unplugged", &unplugged},
    {"lose", &lose}, {"damage", &damage}, {"late", &late}, {"auto_stays", &auto_stays}, {"no_sharpness", &no_sharpness},
    {"every_second_waits", &every_second_waits}, {"fail_gain", &fail_gain}, {"is_open", &is_open}, {"mode", &mode},
    {"pending", &pending}, {"gain", &gain}, {"auto_exposure", &auto_exposure}, {"exposures", &exposures},
    {"releases_missing", &releases_missing}, {"gamma", &gamma_now}, {"contrast", &contrast_now}, {"mirrored", &mirrored},
};

static int *value(const char *name) {
    for (size_t i = 0; i < sizeof values / sizeof *values; i++)
        if (strcmp(values[i].name, name) == 0) return values[i].value;
    abort();
}

void stand_in_set(const char *name, int to) { *value(name) = to; }
int stand_in_get(const char *name) { return *value(name); }

int stand_in_size(const char *name) {
    if (!strcmp(name, "DeviceInfo")) return sizeof(DeviceInfo);
    if (!strcmp(name, "Resolution")) return sizeof(Resolution);
    if (!strcmp(name, "Capability")) return sizeof(Capability);
    if (!strcmp(name, "FrameHead")) return sizeof(FrameHead);
    return sizeof(Statistic);
}

int CameraSdkInit(int language) { return SUCCESS; }

int CameraEnumerateDevice(DeviceInfo *list, int *n) {
    if (cameras == 0) return -16;
    *n = cameras < *n ? cameras : *n;
    for (int i = 0; i < *n; i++) {
        memset(&list[i], 0, sizeof list[i]);
        strcpy(list[i].product, "MV-U300");
        strcpy(list[i].serial, i ? "049000000002" : "049000000001");
    }
    return SUCCESS;
}

int CameraInit(DeviceInfo *info, int mode_, int team, int *handle) {
    if (held) return ACCESS_DENY;
    if (is_open) return -18;
    is_open = 1;
    *handle = 7;
    return SUCCESS;
}

/* every function asks first: is this the open camera, and is it still there? */
#define ALIVE(handle)                                 \
    do {                                              \
        if ((handle) != 7 || !is_open) return -5;     \
        if (unplugged) return DEVICE_LOST;            \
    } while (0)

int CameraUnInit(int h) {
    is_open = plays = 0;
    return SUCCESS;
}
int CameraStop(int h) { ALIVE(h); plays = 0; return SUCCESS; }
int CameraPlay(int h) { ALIVE(h); plays = 1; return SUCCESS; }
int CameraPause(int h) { ALIVE(h); plays = 0; pending = 0; return SUCCESS; }
int CameraClearBuffer(int h) { ALIVE(h); if (!late) pending = 0; return SUCCESS; }
int CameraConnectTest(int h) { ALIVE(h); return silent ? DEVICE_LOST : SUCCESS; }

int CameraGetCapability(int h, Capability *can) {
    ALIVE(h);
    memset(can, 0, sizeof *can);
    can->triggers = triggers;
    can->gain_min = 8, can->gain_max = 64, can->gain_step = 0.125f;
    can->lines_min = 1, can->lines_max = 8000;
    can->width_max = 64, can->height_max = 48, can->width_min = 16, can->height_min = 4;
    can->gamma[1] = 250, can->contrast[1] = 200, can->sharpness[1] = 100;
    can->mono = !colour, can->auto_exposure = can->manual_exposure = 1;
    return SUCCESS;
}

int CameraSetTriggerMode(int h, int m) {
    ALIVE(h);
    if (m >= triggers) return NOT_SUPPORTED;
    mode = m, pending = 0;
    return SUCCESS;
}
int CameraSetTriggerCount(int h, int n) { ALIVE(h); return SUCCESS; }
int CameraSoftTrigger(int h) {
    ALIVE(h);
    if (mode != 1 || !plays) return -30;
    pending++;
    return SUCCESS;
}

int CameraSetAeState(int h, int on) { ALIVE(h); if (!auto_stays) auto_exposure = on; return SUCCESS; }
int CameraGetAeState(int h, int *on) { ALIVE(h); *on = auto_exposure; return SUCCESS; }
int CameraGetExposureLineTime(int h, double *us) { ALIVE(h); *us = 25.0; return SUCCESS; }
int CameraSetExposureTime(int h, double us) {
    ALIVE(h);
    exposure_us = 25.0 * (int)(us / 25.0 + 0.5); /* whole lines */
    return SUCCESS;
}
int CameraGetExposureTime(int h, double *us) { ALIVE(h); *us = exposure_us; return SUCCESS; }
int CameraSetAnalogGain(int h, int g) {
    ALIVE(h);
    if (fail_gain && fail_gain--) return OUT_OF_BOUND;
    gain = g;
    return SUCCESS;
}
int CameraGetAnalogGain(int h, int *g) { ALIVE(h); *g = gain; return SUCCESS; }

int CameraSetImageResolution(int h, Resolution *r) {
    ALIVE(h);
    if (r->index != 0xFF || r->x + r->width_fov > 64 || r->y + r->height_fov > 48) return OUT_OF_BOUND;
    resolution = *r;
    resolution.x = r->x / 4 * 4, resolution.width = r->width / 4 * 4; /* steps of the sensor */
    return SUCCESS;
}
int CameraGetImageResolution(int h, Resolution *r) { ALIVE(h); *r = resolution; return SUCCESS; }

int CameraSetIspOutFormat(int h, uint32_t format) { ALIVE(h); out_format = format; return SUCCESS; }
int CameraSetLutMode(int h, int m) { ALIVE(h); return SUCCESS; }
int CameraSetGamma(int h, int g) { ALIVE(h); gamma_now = g; return SUCCESS; }
int CameraSetContrast(int h, int c) { ALIVE(h); contrast_now = c; return SUCCESS; }
int CameraSetSharpness(int h, int s) { ALIVE(h); return no_sharpness ? NOT_SUPPORTED : SUCCESS; }
int CameraSetSaturation(int h, int s) { ALIVE(h); return SUCCESS; }
int CameraSetNoiseFilter(int h, int on) { ALIVE(h); return SUCCESS; }
int CameraSetMirror(int h, int direction, int on) { ALIVE(h); mirrored = on; return SUCCESS; }
int CameraSetWbMode(int h, int automatic) { ALIVE(h); return SUCCESS; }
int CameraSetGain(int h, int r, int g, int b) { ALIVE(h); return SUCCESS; }
int CameraSetFrameSpeed(int h, int s) { ALIVE(h); return s > 2 ? OUT_OF_BOUND : SUCCESS; }

int CameraGetFrameStatistic(int h, Statistic *s) {
    ALIVE(h);
    s->total = exposures, s->captured = exposures - lost, s->lost = lost;
    return SUCCESS;
}

int CameraGetImageBuffer(int h, FrameHead *head, uint8_t **buffer, uint32_t ms) {
    ALIVE(h);
    if (!plays || mode == 2 || silent) return TIME_OUT;
    if (mode == 1) {
        if (pending == 0) return TIME_OUT;
        if (late) return TIME_OUT; /* triggered, but not here yet */
        pending--;
    }
    if (mode == 0 && every_second_waits && calls++ % 2 == 0) return TIME_OUT;
    if (lose) lost += lose, exposures += lose, lose = 0;
    exposures++;
    if (damage) { damage--; return LOST_DATA; }
    if (releases_missing) abort(); /* the library blocks when its buffer is not given back */
    releases_missing++;
    memset(head, 0, sizeof *head);
    head->media_type = 0x01080001, head->width = resolution.width, head->height = resolution.height;
    head->bytes = head->width * head->height, head->triggered = mode != 0, head->exposure_us = (uint32_t)exposure_us;
    for (int v = 0; v < head->height; v++)
        for (int u = 0; u < head->width; u++) raw[v * head->width + u] = (uint8_t)(u + v);
    raw[0] = (uint8_t)exposures, raw[1] = (uint8_t)(exposure_us / 1000);
    *buffer = raw;
    return SUCCESS;
}

int CameraReleaseImageBuffer(int h, uint8_t *buffer) {
    if (buffer != raw) return -6;
    releases_missing--;
    return SUCCESS;
}

int CameraImageProcess(int h, uint8_t *in, uint8_t *out, FrameHead *head) {
    ALIVE(h);
    int n = head->width * head->height;
    if (out_format == 0x01080001) {
        memcpy(out, in, n);
    } else { /* red as it is, green 10 less, blue 20 less */
        for (int i = 0; i < n; i++) out[3 * i] = in[i], out[3 * i + 1] = in[i] - 10, out[3 * i + 2] = in[i] - 20;
    }
    head->media_type = out_format;
    return SUCCESS;
}
