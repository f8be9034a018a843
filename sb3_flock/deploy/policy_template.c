$header
#ifndef FLOCK_POLICY_H
#define FLOCK_POLICY_H

/* Most bodies that an input holds; another number needs -DFLOCK_MAX_NEIGHBORS=... in all files of a program. */
#ifndef FLOCK_MAX_NEIGHBORS
#define FLOCK_MAX_NEIGHBORS 16
#endif
#ifndef FLOCK_MAX_OBSTACLES
#define FLOCK_MAX_OBSTACLES 8
#endif

/* Largest coordinate that is read [m]. A body at (FLOCK_NOT_SENSED, FLOCK_NOT_SENSED) is ignored, as all out of range are. */
#define FLOCK_NOT_SENSED 1e15f

#define FLOCK_OK 0
#define FLOCK_STOPPED 1 /* an input was not readable: the speed is 0 */

#define FLOCK_TIME_STEP $time_step /* sampling period [s] */
//: if lag
#define FLOCK_MOTION_LAG_STEPS $motion_lag_steps /* `previous` was measured so many sampling periods ago */
//: end

typedef struct {
    float x; /* forward [m] */
    float y; /* to the left [m] */
} FlockPoint;

typedef struct {
    int n_neighbors; /* more than FLOCK_MAX_NEIGHBORS: the vehicle stops */
    int n_obstacles;
    FlockPoint neighbors[FLOCK_MAX_NEIGHBORS];
    FlockPoint obstacles[FLOCK_MAX_OBSTACLES]; $obstacles_comment
    FlockPoint waypoint;
} FlockMeasurement;

typedef struct {
    FlockMeasurement now;
//: if lag
    FlockMeasurement previous; /* of FLOCK_MOTION_LAG_STEPS ago, in the body frame of that time; at first the first one */
//: if motion
    /* Row k of previous.neighbors is the neighbor of row k of now.neighbors; FLOCK_NOT_SENSED where it was or is not sensed. */
//: end
    FlockPoint ego_position; /* of the vehicle now, in the body frame of `previous`, from odometry [m] */
    float ego_turn; /* of the vehicle since then, to the left positive [rad] */
//: end
//: if headings
    float neighbor_headings[FLOCK_MAX_NEIGHBORS]; /* relative to the own one, left positive, -2 pi to 2 pi [rad]; NaN: unknown */
//: end
//: if estimates
    float neighbor_stds[FLOCK_MAX_NEIGHBORS]; /* standard deviation of each coordinate of their estimates [m]; NaN: not approached */
//: end
//: if reserves
    float own_speed; /* of the vehicle now [m/s] */
//: end
} FlockInput;

typedef struct {
    float speed; /* to hold for one sampling period [m/s] */
    float turn_rate; /* to the left positive [rad/s] */
//: if filtered
    float asked_speed; /* of the controller, before the filter [m/s] */
    float asked_turn_rate; /* [rad/s] */
//: end
//: if announce
    float announced_speed; /* to send to the neighbors [m/s] */
//: end
} FlockOutput;

/* The action of the policy. It returns FLOCK_OK or FLOCK_STOPPED. Not reentrant: it works in static memory. */
int flock_decide(const FlockInput *input, FlockOutput *output);
//: if filtered

/* The safety filter alone, for another controller: it reads asked_speed and asked_turn_rate, and sets the rest of the output. */
int flock_filter(const FlockInput *input, FlockOutput *output);
//: end
//: if announce

/* The second stage of a step, after the neighbors' announcements have arrived, in the order of now.neighbors [m/s]; 0 or NaN where
   none has. It may raise `speed`. Without it the vehicle executes `speed` as it is, which is safe, too. The input is that of
   flock_decide. A vehicle that has announced a speed has to reach it. */
void flock_raise_speed(const FlockInput *input, const float announced_speeds[FLOCK_MAX_NEIGHBORS], FlockOutput *output);
//: end

#endif /* FLOCK_POLICY_H */

#ifndef FLOCK_DECLARATIONS_ONLY

#include <math.h>

#ifdef __FAST_MATH__
#error "compile without -ffast-math: NaN has to be seen, and the bounds on speeds need the rounding of IEEE 754"
#endif

$constants

/* weights (flash) */

$weights

/* activations (RAM) */

static float flock_even[$even_size];
static float flock_odd[$odd_size];

/* what can be read */

static int flock_is_number(float value)
{
    return value >= -FLOCK_NOT_SENSED && value <= FLOCK_NOT_SENSED; /* false for NaN */
}

static int flock_are_points(const FlockPoint *points, int count, int most)
{
    int i;
    if (count < 0 || count > most) {
        return 0;
    }
    for (i = 0; i < count; i++) {
        if (!flock_is_number(points[i].x) || !flock_is_number(points[i].y)) {
            return 0;
        }
    }
    return 1;
}

static int flock_is_measurement(const FlockMeasurement *measured)
{
    return flock_are_points(measured->neighbors, measured->n_neighbors, FLOCK_MAX_NEIGHBORS) &&
           flock_are_points(measured->obstacles, measured->n_obstacles, FLOCK_MAX_OBSTACLES) &&
           flock_are_points(&measured->waypoint, 1, 1);
}

static int flock_is_readable(const FlockInput *input)
{
//: if lag
    if (!flock_is_measurement(&input->previous) || !flock_are_points(&input->ego_position, 1, 1) ||
        !flock_is_number(input->ego_turn)) {
        return 0;
    }
//: end
//: if reserves
    if (!(input->own_speed >= 0.0f && input->own_speed <= FLOCK_NOT_SENSED)) {
        return 0;
    }
//: end
//: if motion
    if (input->previous.n_neighbors != input->now.n_neighbors) {
        return 0;
    }
//: end
    return flock_is_measurement(&input->now);
}

static int flock_stop(FlockOutput *output)
{
    static const FlockOutput stop = {0};
    *output = stop;
    return FLOCK_STOPPED;
}

static float flock_clip(float value, float low, float high)
{
    return value < low ? low : value > high ? high : value;
}

static float flock_distance(FlockPoint point)
{
    return sqrtf(point.x * point.x + point.y * point.y);
}

/* observation: sums of Gaussians at the anchors, section IV-A of arXiv:1806.00196; channels last */

typedef struct {
    float x, y, cos, sin; /* the present body frame, in the one of the measurement */
} FlockFrame;

static const FlockFrame flock_present = {0.0f, 0.0f, 1.0f, 0.0f};

static FlockPoint flock_to_present(FlockPoint point, const FlockFrame *frame)
{
    const float x = point.x - frame->x, y = point.y - frame->y;
    FlockPoint moved;
    moved.x = frame->cos * x + frame->sin * y;
    moved.y = frame->cos * y - frame->sin * x;
    return moved;
}

static void flock_show(FlockPoint point, float per_sigma, int channel)
{
    float along_x[FLOCK_SIDE], along_y[FLOCK_SIDE];
    int a, b;
    for (a = 0; a < FLOCK_SIDE; a++) {
        const float anchor = ((float)a - 0.5f * (float)(FLOCK_SIDE - 1)) * FLOCK_SIGMAS_PER_ANCHOR;
        const float x = point.x * per_sigma - anchor, y = point.y * per_sigma - anchor;
        along_x[a] = expf(-0.5f * x * x);
        along_y[a] = expf(-0.5f * y * y);
    }
    for (a = 0; a < FLOCK_SIDE; a++) {
        for (b = 0; b < FLOCK_SIDE; b++) {
            flock_even[(a * FLOCK_SIDE + b) * FLOCK_CHANNELS + channel] += along_x[a] * along_y[b];
        }
    }
}

static void flock_show_bodies(const FlockPoint *points, int count, float range, const FlockFrame *frame, float per_sigma,
                              int channel)
{
    int i;
    for (i = 0; i < count; i++) {
        if (flock_distance(points[i]) < range) {
            flock_show(flock_to_present(points[i], frame), per_sigma, channel);
        }
    }
}

static void flock_show_waypoint(FlockPoint point, float radius, const FlockFrame *frame, float per_sigma, int channel)
{
    const FlockPoint moved = flock_to_present(point, frame);
    const float distance = flock_distance(moved), share = distance > radius ? radius / distance : 1.0f;
    FlockPoint shown;
    shown.x = moved.x * share;
    shown.y = moved.y * share;
    flock_show(shown, per_sigma, channel);
}

static void flock_show_measurement(const FlockMeasurement *measured, const FlockFrame *frame, int first)
{
$show_channels
}

//: if lag
static FlockFrame flock_frame(const FlockInput *input)
{
    FlockFrame frame;
    frame.x = input->ego_position.x;
    frame.y = input->ego_position.y;
    frame.cos = cosf(input->ego_turn);
    frame.sin = sinf(input->ego_turn);
    return frame;
}

//: end
static void flock_observe(const FlockInput *input)
{
    int i;
//: if lag
    const FlockFrame frame = flock_frame(input);
    int channel;
//: end
    for (i = 0; i < FLOCK_SIDE * FLOCK_SIDE * FLOCK_CHANNELS; i++) {
        flock_even[i] = 0.0f;
    }
    flock_show_measurement(&input->now, &flock_present, 0);
//: if lag
    flock_show_measurement(&input->previous, &frame, FLOCK_CHANNELS / 2);
    for (i = 0; i < FLOCK_SIDE * FLOCK_SIDE; i++) { /* the motion channels: present minus previous */
        float *anchor = flock_even + i * FLOCK_CHANNELS;
        for (channel = 0; channel < FLOCK_CHANNELS / 2; channel++) {
            anchor[FLOCK_CHANNELS / 2 + channel] = anchor[channel] - anchor[FLOCK_CHANNELS / 2 + channel];
        }
    }
//: end
}

/* network */

static float flock_dot(const float *a, const float *b, int count)
{
    float sum0 = 0.0f, sum1 = 0.0f, sum2 = 0.0f, sum3 = 0.0f; /* four chains, which do not wait for each other */
    int i;
    for (i = 0; i + 3 < count; i += 4) {
        sum0 += a[i] * b[i];
        sum1 += a[i + 1] * b[i + 1];
        sum2 += a[i + 2] * b[i + 2];
        sum3 += a[i + 3] * b[i + 3];
    }
    for (; i < count; i++) {
        sum0 += a[i] * b[i];
    }
    return (sum0 + sum1) + (sum2 + sum3);
}

static void flock_dense(const float *in, int n_in, const float *weights, const float *biases, float *out, int n_out)
{
    int i;
    for (i = 0; i < n_out; i++) {
        out[i] = biases[i] + flock_dot(weights + i * n_in, in, n_in);
    }
}

//: if convolutions
static void flock_convolve(const float *in, int side, int channels, int kernel, int stride, const float *weights,
                           const float *biases, float *out, int out_channels)
{
    const int out_side = (side - kernel) / stride + 1, row = kernel * channels;
    int a, b, i, k;
    for (a = 0; a < out_side; a++) {
        for (b = 0; b < out_side; b++) {
            const float *corner = in + (a * side + b) * stride * channels;
            for (i = 0; i < out_channels; i++) {
                float sum = biases[i];
                for (k = 0; k < kernel; k++) {
                    sum += flock_dot(weights + (i * kernel + k) * row, corner + k * side * channels, row);
                }
                *out++ = sum;
            }
        }
    }
}

//: end
//: if layer_norm
static void flock_layer_norm(float *values, int count, const float *weights, const float *biases, float epsilon)
{
    float mean = 0.0f, variance = 0.0f, scale;
    int i;
    for (i = 0; i < count; i++) {
        mean += values[i];
    }
    mean /= (float)count;
    for (i = 0; i < count; i++) {
        variance += (values[i] - mean) * (values[i] - mean);
    }
    scale = 1.0f / sqrtf(variance / (float)count + epsilon);
    for (i = 0; i < count; i++) {
        values[i] = (values[i] - mean) * scale * weights[i] + biases[i];
    }
}

//: end
static void flock_relu(float *values, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        values[i] = values[i] < 0.0f ? 0.0f : values[i];
    }
}

//: if tanh
static float flock_bound(float value) /* tanh */
{
    return 1.0f - 2.0f / (expf(2.0f * flock_clip(value, -20.0f, 20.0f)) + 1.0f);
}
//: end
//: if clamp
static float flock_bound(float value)
{
    return flock_clip(value, -1.0f, 1.0f);
}
//: end

/* From the observation in flock_even to the action in [-1, 1]. */
static const float *flock_network(void)
{
$network
}

//: if filtered
/* safety filter: docs/safety.md has the proof */

/* By how much a speed of 1 m/s approaches each body in range in a step [s], and by how much the vehicle may approach it [m]. */
typedef struct {
    int count;
    float strides[FLOCK_BOUNDS_PER_BODY * (FLOCK_MAX_NEIGHBORS + FLOCK_MAX_OBSTACLES)];
    float budgets[FLOCK_BOUNDS_PER_BODY * (FLOCK_MAX_NEIGHBORS + FLOCK_MAX_OBSTACLES)];
} FlockBounds;

static void flock_add_row(FlockBounds *bounds, float stride, float budget)
{
    bounds->strides[bounds->count] = stride;
    bounds->budgets[bounds->count] = budget > 0.0f ? budget : 0.0f;
    bounds->count++;
}

//: if plain
static void flock_add_bound(const FlockInput *input, FlockBounds *bounds, FlockPoint point, float distance, float budget)
{
    (void)input;
    flock_add_row(bounds, distance > 0.0f ? point.x / distance * FLOCK_TIME_STEP : 0.0f, budget);
}

//: end
//: if reserves
/* The way that the vehicle needs in order to stop is a part of what it approaches. */
static void flock_add_bound(const FlockInput *input, FlockBounds *bounds, FlockPoint point, float distance, float budget)
{
    const float toward = distance > 0.0f ? point.x / distance : 0.0f, stride = toward * FLOCK_TIME_STEP;
    const float ahead = toward > 0.0f ? toward * input->own_speed : 0.0f;
    const float left = budget - ahead * FLOCK_SPEED_LAG;
//: if brakes
    const float braking = 0.5f * ahead * input->own_speed / FLOCK_MAX_ACCELERATION;
    flock_add_row(bounds, stride, left - braking);
    flock_add_row(bounds, stride + ahead / FLOCK_MAX_ACCELERATION, left + braking);
//: end
//: if lags
    flock_add_row(bounds, stride, left);
//: end
}

//: end

//: if neighbor_filter
/* The share of a neighbor's heading that points away from the vehicle, or less where that is not known. */
static float flock_receding(const FlockInput *input, int i, float distance)
{
//: if headings
    const FlockPoint point = input->now.neighbors[i];
    const float heading = input->neighbor_headings[i];
    if (!(heading >= -FLOCK_FULL_TURN && heading <= FLOCK_FULL_TURN) || !(distance > 0.0f)) {
        return -1.0f;
    }
    return (cosf(heading) * point.x + sinf(heading) * point.y) / distance - FLOCK_DIRECTION_RESERVE;
//: end
//: if infers_motion
    const FlockFrame frame = flock_frame(input);
    const FlockPoint point = input->now.neighbors[i], before = flock_to_present(input->previous.neighbors[i], &frame);
    FlockPoint motion;
    float away;
    if (!(flock_distance(input->previous.neighbors[i]) < FLOCK_LINK_RANGE) || !(distance > 0.0f) ||
        !(input->ego_turn >= -FLOCK_FULL_TURN && input->ego_turn <= FLOCK_FULL_TURN)) {
        return -1.0f;
    }
    motion.x = point.x - before.x;
    motion.y = point.y - before.y;
    away = (motion.x * point.x + motion.y * point.y) / distance;
    return away > FLOCK_SIN_TURNED * flock_distance(motion) + FLOCK_MOTION_RESERVE ? 0.0f : -1.0f;
//: end
//: if no_receding
    (void)input, (void)i, (void)distance;
    return -1.0f;
//: end
}

//: end
static void flock_find_bounds(const FlockInput *input, const float *announced_speeds, FlockBounds *bounds)
{
    const FlockMeasurement *now = &input->now;
    int i;
    bounds->count = 0;
//: if neighbor_filter
    for (i = 0; i < now->n_neighbors; i++) {
        const float distance = flock_distance(now->neighbors[i]);
        if (distance < FLOCK_NEIGHBOR_REACH) {
//: if estimates
            const float std = input->neighbor_stds[i] >= 0.0f ? input->neighbor_stds[i] : FLOCK_NOT_SENSED;
            const float free = distance - FLOCK_NEIGHBOR_KEPT - FLOCK_MARGIN_STDS * std;
//: end
//: if measured
            const float free = distance - FLOCK_NEIGHBOR_KEPT;
//: end
            const float gap = free > 0.0f ? free : 0.0f;
            const float receding = flock_receding(input, i, distance);
            float budget = receding >= 0.0f ? gap : 0.5f * gap;
            if (announced_speeds && announced_speeds[i] > 0.0f && flock_is_number(announced_speeds[i]) && receding > 0.0f) {
                budget += receding * flock_clip(announced_speeds[i], 0.0f, FLOCK_MAX_SPEED) * FLOCK_TIME_STEP;
            }
            flock_add_bound(input, bounds, now->neighbors[i], distance, budget);
        }
    }
//: end
//: if obstacle_filter
    for (i = 0; i < now->n_obstacles; i++) { /* the worst obstacle comes straight on at its top speed */
        const float distance = flock_distance(now->obstacles[i]);
        if (distance < FLOCK_OBSTACLE_REACH) {
            const float gap = distance > FLOCK_OBSTACLE_KEPT ? distance - FLOCK_OBSTACLE_KEPT : 0.0f;
            flock_add_bound(input, bounds, now->obstacles[i], distance, gap);
        }
    }
//: end
    (void)announced_speeds;
}

/* The highest speed with which the vehicle approaches no body by more than its budget, or the floor, which is not lower than 0. */
static float flock_limit_speed(float asked, float floor, const FlockBounds *bounds)
{
    float speed = asked;
    int i;
    for (i = 0; i < bounds->count; i++) {
        const float stride = bounds->strides[i], allowed = bounds->budgets[i] - 2.0f * FLOCK_RESERVE;
        if (stride > 0.0f && stride * speed > allowed) {
            const float most = allowed > 0.0f ? allowed / stride * FLOCK_DOWN : 0.0f;
            speed = most < speed ? most : speed;
        }
    }
    for (i = 0; i < bounds->count; i++) {
        if (bounds->strides[i] * speed > bounds->budgets[i] - FLOCK_RESERVE) {
            return floor;
        }
    }
    return speed > floor ? speed : floor;
}

int flock_filter(const FlockInput *input, FlockOutput *output)
{
    FlockBounds bounds;
    if (!flock_is_readable(input) || !flock_is_number(output->asked_speed) || !flock_is_number(output->asked_turn_rate)) {
        return flock_stop(output);
    }
    output->asked_speed = flock_clip(output->asked_speed, 0.0f, FLOCK_MAX_SPEED);
    output->asked_turn_rate = flock_clip(output->asked_turn_rate, -FLOCK_MAX_TURN_RATE, FLOCK_MAX_TURN_RATE);
    flock_find_bounds(input, 0, &bounds);
    output->turn_rate = output->asked_turn_rate;
    output->speed = flock_limit_speed(output->asked_speed, 0.0f, &bounds);
//: if announce
    output->announced_speed = output->speed;
//: end
//: if announces_less
    output->announced_speed = output->speed < input->own_speed ? output->speed : input->own_speed;
//: end
    return FLOCK_OK;
}

//: if announce
void flock_raise_speed(const FlockInput *input, const float announced_speeds[FLOCK_MAX_NEIGHBORS], FlockOutput *output)
{
    FlockBounds bounds;
    float floor = output->announced_speed;
    if (flock_is_readable(input)) {
//: if announces_less
        flock_find_bounds(input, 0, &bounds);
        floor = flock_limit_speed(output->asked_speed, 0.0f, &bounds);
//: end
        flock_find_bounds(input, announced_speeds, &bounds);
        output->speed = flock_limit_speed(output->asked_speed, floor, &bounds);
    }
}

//: end
//: end
int flock_decide(const FlockInput *input, FlockOutput *output)
{
    const float *action;
    float speed, turn_rate;
    if (!flock_is_readable(input)) {
        return flock_stop(output);
    }
    flock_observe(input);
    action = flock_network();
    speed = $speed;
    turn_rate = $turn_rate;
    if (!flock_is_number(speed) || !flock_is_number(turn_rate)) {
        return flock_stop(output);
    }
//: if filtered
    output->asked_speed = speed;
    output->asked_turn_rate = turn_rate;
    return flock_filter(input, output);
//: end
//: if unfiltered
    output->speed = flock_clip(speed, 0.0f, FLOCK_MAX_SPEED);
    output->turn_rate = flock_clip(turn_rate, -FLOCK_MAX_TURN_RATE, FLOCK_MAX_TURN_RATE);
    return FLOCK_OK;
//: end
}

#endif /* FLOCK_DECLARATIONS_ONLY */
