/*
 * {{ c }}: the control loop of one joint, {{ joint }}; see {{ c }}.h
 *
 * Each function is what hpid_ros/control has of the same name, sum by sum: the
 * order of the operations is part of it.
 */
#include "{{ c }}.h"

#include <float.h>
#include <math.h>
#include <stddef.h>

#ifdef __FAST_MATH__
#error "-ffast-math takes it that no number is infinite or none at all"
#endif
#ifdef __clang__
#pragma STDC FP_CONTRACT OFF
#endif

typedef {{ c }}_real Real;
typedef {{ c }}_settings_type Settings;
typedef {{ c }}_coefficients Coefficients;
typedef {{ c }}_estimate Estimate;
typedef {{ c }}_passage Passage;
typedef {{ c }}_fade Fade;
typedef {{ c }}_encoder Encoder;
typedef {{ c }}_sources Sources;
typedef {{ c }}_state State;

#define REAL(number) {{ C }}_REAL(number)
#define INFINITE ((Real)INFINITY)

#if {{ C }}_SINGLE
#define POW powf
#define EXP expf
#define LOG logf
#define ABS fabsf
#define LARGEST FLT_MAX
#define LARGEST_MULTIPLIER REAL(1e10) /* its cube times a gain is a number */
#define WHOLE REAL(8388608.0) /* from here on all numbers are, 2^23 */
#define SPLIT REAL(4097.0) /* halves a significand, 2^12 + 1 */
#define TOLERANCE REAL(1e-6) /* of Newton's method, relative */
#define SMALLEST REAL(-55.0) /* of ln n: exp of -1.5 times it is a number */
#define SLACK REAL(1.000001) /* a time that is as long but for its rounding is no longer */
#else
#define POW pow
#define EXP exp
#define LOG log
#define ABS fabs
#define LARGEST DBL_MAX
#define LARGEST_MULTIPLIER REAL(1e100) /* its cube times a gain is a number */
#define WHOLE REAL(4503599627370496.0)
#define SPLIT REAL(134217729.0)
#define TOLERANCE REAL(1e-15)
#define SMALLEST REAL(-400.0)
#define SLACK REAL(1.0)
#endif

/* Positions, velocities and references beyond this are no joint's [rad, rad/s]. */
#define LARGEST_POSITION {{ largest_position|real }}

/* No encoder begins anew after less [rad]. */
#define LEAST_WRAP {{ least_wrap|real }}

/* A limit of position or velocity of this size is none [rad, rad/s]. */
#define LARGEST_MOTION {{ largest_motion|real }}

#define TURN {{ math.tau|real }} /* [rad] */
#define NANOSECOND REAL(1e-9) /* [s] */
#define SLOPE_MARGIN REAL(1e-6) /* of ln n */
#define HALF REAL(1e-9) /* of a turn: as much more than half of one is half of one */
#define ITERATIONS 60 /* of Newton's method, at most */
#define PEAK REAL(1.875) /* largest rate of a smooth step, of its height in its duration */
#define LONGEST REAL(3600.0) /* of a glide [s] */

const {{ c }}_settings_type {{ c }}_settings = {
{% for field in fields %}
{% set value = values[field.parameter] %}
    .{{ field.name }} = {{ value|real if field.range else field.enumerator(C, value) if field.choices else value|lower }}{{ "," if not loop.last }}
{% endfor %}
};

/* -- Numbers ------------------------------------------------------------- */

static Real larger(Real one, Real other)
{
    return other > one ? other : one;
}

static Real smaller(Real one, Real other)
{
    return other < one ? other : one;
}

static Real clamped(Real number, Real least, Real most)
{
    return smaller(larger(number, least), most);
}

static bool is_finite(Real number)
{
    return -LARGEST <= number && number <= LARGEST;
}

static bool is_positive(Real number)
{
    return number > 0 && number <= LARGEST;
}

static bool is_within(Real number, Real least, Real most)
{
    return least <= number && number <= most;
}

/* Return the nearest whole number, of two the even one. */
static Real rounded(Real number)
{
    volatile Real sum; /* no compiler may take this for number itself */
    if (!(ABS(number) < WHOLE))
        return number;
    sum = number < 0 ? number - WHOLE : number + WHOLE;
    return number < 0 ? sum + WHOLE : sum - WHOLE;
}

/* Return the square root: that of pow, whose last place Newton's step sets right. */
static Real root(Real number)
{
    Real guess = POW(number, REAL(0.5));
    Real high, low, split, square;
    if (!is_positive(guess) || !is_finite(guess * SPLIT))
        return guess;
    split = guess * SPLIT; /* Dekker's product: guess^2 = square + low, exactly */
    high = split - (split - guess);
    low = guess - high;
    square = guess * guess;
    low = ((high * high - square) + REAL(2.0) * high * low) + low * low;
    return guess + ((number - square) - low) / (REAL(2.0) * guess);
}

/* Return the time from one stamp to another [s]; no difference of stamps overflows. */
static Real seconds(int64_t from_ns, int64_t to_ns)
{
    if (to_ns >= from_ns)
        return (Real)((uint64_t)to_ns - (uint64_t)from_ns) * NANOSECOND;
    return -(Real)((uint64_t)from_ns - (uint64_t)to_ns) * NANOSECOND;
}

/* -- The homogeneous norm ------------------------------------------------ */

/* The exponent of a square: Python's pow(x, 2) is not x x to the last bit, and
 * a compiler that knows the exponent makes it that. */
static const volatile Real TWO = 2;

/* Return gamma_1 |e|^(1/(1-mu)) + gamma_2 |de|; not a number if the power has none. */
static Real weighted_norm(const Coefficients *c, Real error, Real error_rate)
{
    Real power = POW(ABS(error), c->error_exponent);
    if (!is_finite(power))
        return (Real)NAN;
    return c->error_weight * power + c->rate_weight * ABS(error_rate);
}

/* Return s = ln n of a point of about unit size: Newton's method, safeguarded by bisection. */
static Real solve_norm(const Coefficients *c, Real error, Real error_rate)
{
    Real r = 1 - c->degree;
    Real square = c->p11 * error * error + c->p22 * POW(error_rate, TWO);
    Real start = REAL(0.5) * LOG(square);
    Real one = start / c->fastest, other = start / c->slowest;
    Real low = smaller(one, other) - SLOPE_MARGIN;
    Real high = larger(one, other) + SLOPE_MARGIN;
    Real s = clamped(start, low, high);
    int count;
    for (count = 0; count < ITERATIONS; count++) {
        Real x1 = error * EXP(-r * s), x2 = error_rate * EXP(-s);
        Real a = c->p11 * x1 * x1, b = c->p22 * x2 * x2, value, move;
        square = a + b;
        value = LOG(square);
        if (value > 0)
            low = s;
        else
            high = s;
        move = value * square / (REAL(2.0) * (r * a + b));
        if (!(low <= s + move && s + move <= high))
            move = REAL(0.5) * (low + high) - s;
        s += move;
        if (ABS(move) <= TOLERANCE * (1 + ABS(s)))
            break;
    }
    return s;
}

/* Return the n > 0 of which |d(-ln n) x|_P = 1; not a number if there is none. */
static Real canonical_norm(const Coefficients *c, Real error, Real error_rate)
{
    Real r = 1 - c->degree, scale, x1, x2, n;
    if (error == 0 && error_rate == 0)
        return 0;
    scale = larger(error != 0 ? LOG(ABS(error)) / r : -INFINITE,
        error_rate != 0 ? LOG(ABS(error_rate)) : -INFINITE);
    if (scale < SMALLEST) { /* the reciprocal has no number; in two steps it needs none */
        Real growth = EXP(-r * REAL(0.5) * scale);
        x1 = error * growth * growth;
        x2 = 0;
        if (error_rate != 0) { /* else the growth of what is 0 need not be a number */
            growth = EXP(-REAL(0.5) * scale);
            x2 = error_rate * growth * growth;
        }
    } else {
        x1 = error * EXP(-r * scale);
        x2 = error_rate * EXP(-scale);
    }
    n = EXP(scale + solve_norm(c, x1, x2));
    return is_finite(n) ? n : (Real)NAN;
}

static Real norm(const Settings *s, const Coefficients *c, Real error, Real error_rate)
{
{% for each in norms[1:] %}
    if (s->norm_type == {{ C }}_NORM_TYPE_{{ each.type|upper }})
        return {{ each.c_function }}(c, error, error_rate);
{% endfor %}
    return {{ norms[0].c_function }}(c, error, error_rate);
}

/* Return n^mu, the factor of the loop's bandwidth; n is held between floor and cap. */
static Real multiplier(const State *loop, Real error, Real error_rate)
{
    const Coefficients *c = &loop->own.coefficients;
    Real n = norm(&loop->settings, c, error, error_rate);
    if (!is_finite(n) && !(n > 0))
        return n;
    n = clamped(n, c->floor, loop->settings.norm_cap);
    if (n == 0)
        return c->degree == 0 ? REAL(1.0) : REAL(0.0);
    return smaller(POW(n, c->degree), LARGEST_MULTIPLIER);
}

/* -- The law ------------------------------------------------------------- */

/*
 * Set the terms of the law and return its effort [N m], with the integral before
 * this sample's increment; the integral is that after it.
 */
static Real law(State *loop, Real error, Real error_rate, Real dt)
{
    const Settings *s = &loop->settings;
    Real p = s->gains_p, i = s->gains_i, d = s->gains_d;
    loop->term_i = loop->integral;
    if (loop->own.coefficients.is_linear) {
        loop->term_p = p * error;
        loop->term_d = d * error_rate;
        loop->integral += dt * (i * error);
    } else {
        Real factor = multiplier(loop, error, error_rate);
        Real square = factor * factor;
        if (s->discretization == {{ C }}_DISCRETIZATION_EXPLICIT) {
            loop->term_p = p * square * error;
            loop->term_d = d * factor * error_rate;
            loop->integral += dt * (i * (square * factor) * error);
        } else { /* error and rate at the end of the sample, as inertia moves them */
            Real stiffness = p * square, damping = d * factor, period = s->control_period;
            Real moved = period / s->inertia;
            Real divisor = 1 + moved * (damping + period * stiffness);
            Real after = ((1 + moved * damping) * error + period * error_rate) / divisor;
            loop->term_p = stiffness * error / divisor;
            loop->term_d = (damping + period * stiffness) * error_rate / divisor;
            loop->integral += dt * (i * (square * factor) * after);
        }
    }
    return loop->term_p + loop->term_d + loop->term_i;
}

/* -- Limits -------------------------------------------------------------- */

/* Take the stops where the joint is, if it is beyond them. */
static void open_stops(State *loop, Real position)
{
    loop->own.low = smaller(loop->own.coefficients.lower, position);
    loop->own.high = larger(loop->own.coefficients.upper, position);
}

/* Bring a stop that was taken further out back to where it belongs. */
static void follow_inwards(State *loop, Real position)
{
    const Coefficients *c = &loop->own.coefficients;
    if (loop->own.high > c->upper && position < loop->own.high)
        loop->own.high = larger(position, c->upper);
    if (loop->own.low < c->lower && position > loop->own.low)
        loop->own.low = smaller(position, c->lower);
}

/*
 * Return the effort that may be given [N m]: within the effort limits, and where
 * there are any, held by soft stops, velocity limit and rate limit. "before" is
 * the effort in force, dt [s] the time since it came into force.
 */
static Real limited(State *loop, Real wanted, Real velocity, Real before, Real dt)
{
    const Coefficients *c = &loop->own.coefficients;
    Real least = loop->settings.u_clamp_min, most = loop->settings.u_clamp_max;
    Real k = c->k_position, most_speed = c->velocity_limit, position = loop->position;
    Real effort = clamped(wanted, least, most), up, down, change;
    if (!c->has_limits)
        return effort;
    follow_inwards(loop, position);
    up = clamped(k * (loop->own.high - position), -most_speed, most_speed) - velocity;
    down = velocity - larger(smaller(k * (loop->own.low - position), most_speed), -most_speed);
    if (up < c->width) {
        if (up <= 0)
            effort = smaller(effort, c->k_velocity * up);
        else if (effort > 0)
            effort *= up / c->width;
    }
    if (down < c->width) {
        if (down <= 0)
            effort = larger(effort, -c->k_velocity * down);
        else if (effort < 0)
            effort *= down / c->width;
    }
    change = dt > 0 || c->rate_limit < INFINITE ? c->rate_limit * dt : INFINITE;
    effort = smaller(larger(effort, before - change), before + change);
    return clamped(effort, least, most);
}

/* Return the integral [N m] for the next sample, of those before and after this one. */
static Real anti_windup(const State *loop, Real before, Real after, Real error, Real wanted,
    Real effort, Real dt)
{
    const Settings *s = &loop->settings;
    switch (s->antiwindup_strategy) {
    case {{ C }}_ANTIWINDUP_STRATEGY_CONDITIONAL_INTEGRATION:
        return error * (wanted - effort) > 0 ? before : after;
    case {{ C }}_ANTIWINDUP_STRATEGY_BACK_CALCULATION:
        if (s->gains_i == 0)
            return after;
        if (dt >= loop->own.coefficients.tracking_time)
            return after + (effort - wanted);
        return after + dt * (effort - wanted) / loop->own.coefficients.tracking_time;
    case {{ C }}_ANTIWINDUP_STRATEGY_NONE:
    default:
        return after;
    }
}

/* Note an effort that is in force for another reason than the law's last sample. */
static void give(State *loop, Real effort)
{
    loop->effort = effort;
    loop->own.is_given = true;
}

/* Return an integral within its limits [N m]. */
static Real allowed_integral(const Settings *s, Real integral)
{
    return s->gains_i > 0 ? clamped(integral, s->i_clamp_min, s->i_clamp_max) : integral;
}

/* Return what is left of an effort that fades [N m]. */
static Real fading(Fade *fade, int64_t stamp_ns)
{
    uint64_t passed = (uint64_t)stamp_ns - (uint64_t)fade->begin_ns;
    if (fade->effort == 0 || stamp_ns <= fade->begin_ns)
        return fade->effort;
    if (passed >= (uint64_t)fade->duration_ns) {
        fade->effort = 0;
        return 0;
    }
    return fade->effort *
        ((Real)((uint64_t)fade->duration_ns - passed) / (Real)fade->duration_ns);
}

/* Let an effort fade from now on [N m]. */
static void keep(State *loop, Real effort, int64_t stamp_ns)
{
    Fade *fade = &loop->own.fade;
    fade->effort = effort + fading(fade, stamp_ns);
    fade->begin_ns = stamp_ns;
    fade->duration_ns = loop->own.coefficients.glide_ns > 0 ? loop->own.coefficients.glide_ns : 1;
}

/*
 * Begin anew with the effort in force: the integral becomes what it needs, and
 * what it may not give fades, as nothing would take it away again.
 */
static void take_over(State *loop, int64_t stamp_ns, bool is_still_damped)
{
    const Settings *s = &loop->settings;
    Real wanted = loop->effort;
    if (is_still_damped && !loop->own.is_given) {
        wanted = loop->term_p + loop->term_i + loop->own.added;
        if (loop->own.coefficients.has_limits && loop->is_limited) /* they took some of it */
            wanted = loop->effort - loop->term_d;
        wanted = clamped(wanted, s->u_clamp_min, s->u_clamp_max);
    }
    loop->integral = s->gains_i > 0 ? allowed_integral(s, wanted) : REAL(0.0);
    loop->own.fade.effort = 0;
    keep(loop, wanted - loop->integral, stamp_ns);
}

/* Put the law's effort, limited, in force; false, and nothing changes, if it is not finite. */
static bool update(State *loop, Real error_rate, Real dt, Real added)
{
    const Settings *s = &loop->settings;
    Real before = loop->integral, error = loop->error;
    Real wanted = law(loop, error, error_rate, dt);
    Real after = loop->integral, effort;
    loop->own.added = added;
    if (added != 0)
        wanted += added;
    if (!is_finite(wanted) || !is_finite(after)) {
        loop->integral = before;
        return false;
    }
    effort = limited(loop, wanted, loop->velocity, loop->effort, dt);
    loop->is_limited = effort != wanted;
    loop->integral = allowed_integral(s,
        anti_windup(loop, before, after, error, wanted, effort, dt));
    loop->effort = effort;
    loop->own.is_given = false;
    return true;
}

/* -- Position and velocity ----------------------------------------------- */

/* Return after how much the encoder wraps around [rad]. */
static Real wrap_of(const State *loop)
{
    return loop->settings.encoder_wrap > 0 ? loop->settings.encoder_wrap : INFINITE;
}

/* Return how far apart two positions are, whatever turns they lie in [rad]. */
static Real distance(const State *loop, Real position, Real other)
{
    Real apart = position - other, wrap = wrap_of(loop);
    if (loop->own.has_unwrapper && ABS(apart) > REAL(0.5) * wrap)
        apart -= wrap * rounded(apart / wrap);
    return ABS(apart);
}

/* Return the continuous position of an encoder that wraps around [rad]. */
static Real unwrapped(State *loop, Real position)
{
    Encoder *encoder = &loop->own.encoder;
    Real wrap = wrap_of(loop);
    if (encoder->has_position) {
        Real before = encoder->position, step = position - before;
        Real most = wrap * (1 + REAL(1e-3)); /* a driver's pi is not quite half a turn */
        if (ABS(step) > REAL(0.5) * wrap && larger(ABS(position), ABS(before)) < most) {
            encoder->turns -= wrap * rounded(step / wrap);
            encoder->has_wrapped = true;
        }
    }
    encoder->position = position;
    encoder->has_position = true;
    return position + encoder->turns;
}

static void reset_encoder(State *loop)
{
    static const Encoder none = {0};
    loop->own.encoder = none;
}

static void reset_estimate(State *loop)
{
    loop->own.estimate.has_position = false;
    loop->own.estimate.velocity = 0;
}

/* Return the backward difference behind a first-order low-pass, by backward Euler [rad/s]. */
static Real filtered(Estimate *past, Real time_constant, Real position, Real dt)
{
    if (past->has_position && dt > 0) {
        Real difference = (position - past->position) / dt;
        past->velocity += dt / (time_constant + dt) * (difference - past->velocity);
    }
    past->has_position = true;
    past->position = position;
    return past->velocity;
}

/* Return the estimate of Levant's differentiator, by backward Euler [rad/s]. */
static Real differentiated(State *loop, Real position, Real dt)
{
    Estimate *past = &loop->own.estimate;
    Real ahead, change, beyond;
    if (!past->has_position) {
        past->has_position = true;
        past->position = position;
        return past->velocity;
    }
    if (dt <= 0)
        return past->velocity;
    ahead = past->position + dt * past->velocity - position;
    change = REAL(1.1) * loop->settings.acceleration_bound * dt;
    beyond = ABS(ahead) - change * dt;
    if (beyond <= 0) {
        past->velocity -= ahead / dt;
        past->position = position;
    } else {
        Real slope = REAL(1.5) * loop->own.coefficients.sqrt_bound * dt;
        Real part = REAL(0.5) * (root(slope * slope + REAL(4.0) * beyond) - slope);
        past->velocity -= ahead < 0 ? -change : change;
        past->position = position + (ahead < 0 ? -(part * part) : part * part);
    }
    return past->velocity;
}

/* Return the velocity of a sample [rad/s]: measured where it is, else estimated. */
static Real velocity_at(State *loop, Real position, const Real *velocity, Real dt)
{
    const Settings *s = &loop->settings;
    Real estimate;
    if (s->velocity_source == {{ C }}_VELOCITY_SOURCE_HOMOGENEOUS_DIFFERENTIATOR)
        return differentiated(loop, position, dt);
    estimate = filtered(&loop->own.estimate, s->velocity_filter_time_constant, position, dt);
    return velocity != NULL ? *velocity : estimate;
}

/* -- The reference ------------------------------------------------------- */

static Real turned(const Passage *passage, Real position)
{
    return passage->turns != 0 ? position + passage->turns : position;
}

/* Return the whole turns in a distance, so that half of one is left at most [rad]. */
static Real whole_turns(Real away, Real turn)
{
    Real count, whole;
    if (turn == 0)
        return 0;
    count = ABS(away / turn) - REAL(0.5) - HALF;
    if (!(count > 0))
        return 0;
    whole = rounded(count);
    if (whole < count)
        whole += 1;
    return away < 0 ? -(turn * whole) : turn * whole;
}

/* Start from where the joint is, and glide onto the reference. */
static void begin_passage(State *loop, int64_t stamp_ns, Real wanted, Real rate)
{
    const Coefficients *c = &loop->own.coefficients;
    Passage *passage = &loop->own.passage;
    Real position = loop->position, turn = c->turn, slowly;
    passage->has_reference = true;
    if (!passage->has_begun && turn == 0) /* the turns until now were not counted */
        turn = c->lost_turn;
    passage->has_begun = true;
    passage->turns += whole_turns(position - turned(passage, wanted), turn);
    wanted = turned(passage, wanted);
    passage->position = position;
    passage->duration = loop->settings.takeover_time;
    if (passage->duration > 0) {
        slowly = PEAK * ABS(position - wanted) / c->velocity_limit;
        passage->duration = smaller(larger(passage->duration, slowly), LONGEST);
    }
    passage->duration_ns = (int64_t)rounded(passage->duration / NANOSECOND);
    passage->is_gliding = passage->duration > 0 && (wanted != position || rate != 0);
    passage->begin_ns = stamp_ns;
}

/* Be between where the glide began and where the reference is, by a smooth step. */
static void glide(const Passage *passage, int64_t stamp_ns, Real *position, Real *velocity)
{
    Real T = passage->duration, s = seconds(passage->begin_ns, stamp_ns) / T;
    Real squared = s * s, away = passage->position - *position;
    Real weight =
        1 - squared * s * (REAL(10.0) - REAL(15.0) * s + REAL(6.0) * squared);
    Real rate = REAL(-30.0) * squared * (1 - REAL(2.0) * s + squared) / T;
    *position = *position + weight * away;
    *velocity = (1 - weight) * *velocity + rate * away;
}

/* Set the reference of a sample: gliding, and within the stops, where it waits. */
static void sample_reference(State *loop, int64_t stamp_ns, Real position, Real velocity)
{
    Passage *passage = &loop->own.passage;
    position = turned(passage, position);
    if (passage->is_gliding) {
        uint64_t passed = (uint64_t)stamp_ns - (uint64_t)passage->begin_ns;
        if (stamp_ns >= passage->begin_ns && passed < (uint64_t)passage->duration_ns)
            glide(passage, stamp_ns, &position, &velocity);
        else if (stamp_ns >= passage->begin_ns)
            passage->is_gliding = false;
    }
    if (loop->own.coefficients.has_limits && position > loop->own.high) {
        position = loop->own.high;
        velocity = 0;
    } else if (loop->own.coefficients.has_limits && position < loop->own.low) {
        position = loop->own.low;
        velocity = 0;
    }
    loop->reference_position = position;
    loop->reference_velocity = velocity;
}

/* -- The settings -------------------------------------------------------- */

static bool are_in_range(const Settings *s)
{
    return
{% for field in fields if field.range %}
        is_within(s->{{ field.name }}, {{ field.range[0]|real }}, {{ field.range[1]|real }}) &&
{% endfor %}
{% for field in fields if field.choices %}
        (unsigned)s->{{ field.name }} <= (unsigned){{ field.enumerator(C, field.choices[-1]) }}{{ ";" if loop.last else " &&" }}
{% endfor %}
}

/* Whether a value is -1, which chooses by itself, or at least so large. */
static bool is_automatic_or(Real value, Real least)
{
    return value == REAL(-1.0) || value >= least;
}

/* Whether the values go together, as far as the norm is not concerned. */
static bool are_consistent(const Settings *s)
{
    bool has_stop = s->position_min > -LARGEST_MOTION || s->position_max < LARGEST_MOTION;
    bool is_stable = s->gains_p > 0 && s->gains_d > 0 &&
        s->gains_p * s->gains_d > s->inertia * s->gains_i;
    return s->u_clamp_min <= s->u_clamp_max && s->i_clamp_min <= s->i_clamp_max &&
        is_automatic_or(s->encoder_wrap, s->encoder_wrap == 0 ? REAL(0.0) : LEAST_WRAP) &&
        is_automatic_or(s->norm_floor, REAL(0.0)) &&
        s->position_min <= s->position_max && !(s->angle_wraparound && (has_stop || s->multi_turn)) &&
        s->state_timeout * SLACK >= REAL(1.5) * s->control_period &&
        REAL(-0.5) < s->mu && s->mu < REAL(0.5) &&
        (s->inertia > 0 ? is_stable : s->discretization == {{ C }}_DISCRETIZATION_EXPLICIT);
}

/* Set the slopes of the canonical norm: generalised eigenvalues of ((PG + GP)/2, P). */
static void set_slopes(Coefficients *c)
{
    Real r = 1 - c->degree;
#if {{ C }}_SINGLE
    c->fastest = larger(r, 1) * (1 + SLOPE_MARGIN);
    c->slowest = smaller(r, 1) * (1 - SLOPE_MARGIN);
#else /* which are these, but for what is lost to rounding */
    Real a = r * c->p11, b = c->p22;
    Real quadratic = c->p11 * c->p22;
    Real linear = a * c->p22 + b * c->p11;
    Real constant = a * b;
    Real part = root(larger(linear * linear - REAL(4.0) * quadratic * constant, 0));
    Real fastest = (linear + part) / (REAL(2.0) * quadratic);
    c->slowest = constant / (quadratic * fastest) * (1 - SLOPE_MARGIN);
    c->fastest = fastest * (1 + SLOPE_MARGIN);
#endif
}

/* Set the norm of the law's degree; false if there is none. */
static bool set_norm(const Settings *s, Coefficients *c)
{
    Real scale = s->norm_error_scale, weight = s->norm_rate_weight;
    c->is_linear = s->law == {{ C }}_LAW_PID &&
        s->discretization == {{ C }}_DISCRETIZATION_EXPLICIT;
    c->degree = s->law == {{ C }}_LAW_HPID ? s->mu : REAL(0.0);
    if (s->norm_effort_scale > 0) {
        if (s->gains_p <= 0 || s->gains_d <= 0 || scale != {{ parameters["norm.error_scale"].default|real }} ||
            weight != {{ parameters["norm.rate_weight"].default|real }})
            return false;
        scale = s->norm_effort_scale / s->gains_p;
        weight = s->gains_d / s->norm_effort_scale;
    }
    c->error_exponent = 1 / (1 - c->degree);
    c->rate_weight = weight;
    if (!is_positive(scale) || !is_positive(weight))
        return false;
    if (s->norm_type == {{ C }}_NORM_TYPE_WEIGHTED) {
        c->error_weight = POW(scale, REAL(-1.0) / (1 - c->degree));
        return is_positive(c->error_weight);
    }
    c->p11 = POW(scale, -TWO);
    c->p22 = POW(weight, TWO);
    if (!is_positive(c->p11) || !is_positive(c->p22) || !is_positive(c->p11 * c->p22))
        return false;
    set_slopes(c);
    return true;
}

/* Set the least value of the norm: given, or what measurement and sampling can bear. */
static bool set_floor(const Settings *s, Coefficients *c)
{
    Real least = REAL(1e-6), gain;
    if (c->is_linear)
        return true;
    if (s->norm_floor >= 0) {
        c->floor = s->norm_floor;
        return c->floor < s->norm_cap;
    }
    if (s->encoder_resolution > 0) { /* two steps of the encoder, and the rate they feign */
        Real step = REAL(2.0) * s->encoder_resolution;
        Real rate = step / (s->velocity_filter_time_constant + s->control_period);
        Real feigned = norm(s, c, step, 0) + norm(s, c, 0, rate);
        if (!(feigned < s->norm_cap))
            return false;
        least = larger(least, feigned);
    }
    gain = s->gains_d / (s->inertia != 0 ? s->inertia : REAL(1.0));
    if (c->degree < 0 && gain > 0) { /* T kd lam / m <= 0.25 */
        Real logarithm = (LOG(REAL(0.25)) - LOG(s->control_period) - LOG(gain)) / c->degree;
        if (!(logarithm < LOG(s->norm_cap)))
            return false;
        least = larger(least, EXP(logarithm));
    }
    c->floor = least;
    return least < s->norm_cap;
}

/* Set the limits of motion, and which positions are believed. */
static void set_limits(const Settings *s, Coefficients *c)
{
    Real p = s->gains_p, d = s->gains_d, speed, allowance;
    bool has_speed = s->velocity_max < LARGEST_MOTION;
    c->lower = s->position_min > -LARGEST_MOTION ? s->position_min : -INFINITE;
    c->upper = s->position_max < LARGEST_MOTION ? s->position_max : INFINITE;
    c->velocity_limit = has_speed ? s->velocity_max : INFINITE;
    c->rate_limit = s->effort_rate_max > 0 ? s->effort_rate_max : INFINITE;
    c->has_limits = c->lower > -INFINITE || c->upper < INFINITE || has_speed ||
        c->rate_limit < INFINITE;

    c->k_position = s->soft_stop_k_position;
    if (c->k_position == 0)
        c->k_position = p > 0 && d > 0 ? REAL(0.75) * p / d : REAL(10.0);
    c->k_velocity = s->soft_stop_k_velocity;
    if (c->k_velocity == 0)
        c->k_velocity = d > 0 ? d : p / c->k_position;
    if (s->inertia > 0) { /* what sampling bears, and what is overdamped */
        if (s->soft_stop_k_velocity == 0)
            c->k_velocity =
                smaller(c->k_velocity, REAL(0.5) * s->inertia / s->control_period);
        if (s->soft_stop_k_position == 0 && c->k_velocity > 0)
            c->k_position =
                smaller(c->k_position, c->k_velocity / (REAL(4.0) * s->inertia));
    }
    c->width = smaller(c->k_position * s->soft_stop_margin, REAL(0.1) * c->velocity_limit);

    allowance = s->position_step_max;
    if (allowance == 0)
        allowance = has_speed ? REAL(0.1) : {{ math.pi|real }};
    speed = has_speed ? REAL(2.0) * s->velocity_max : REAL(0.0);
    c->step_max = allowance + speed * s->control_period;
    c->speed_max = speed;
    if (allowance >= LARGEST_MOTION) {
        c->step_max = INFINITE;
        c->speed_max = 0;
    }
}

/* Set what the states of one source may do. */
static void set_sources(const Settings *s, Coefficients *c)
{
    Real counts = {{ sources.counts|real }} * s->encoder_resolution;
    c->apart = larger(larger({{ sources.agree_within|real }}, counts), s->position_step_max);
    c->twice = larger({{ sources.same_stamp_within|real }}, counts);
    c->source_turn = s->encoder_wrap > 0 ? s->encoder_wrap : TURN;
    c->back_ns = (int64_t)rounded(s->state_timeout / NANOSECOND);
    c->window_ns =
        (int64_t)rounded(({{ sources.window|real }} + s->state_timeout) / NANOSECOND);
}

/* Set what follows from the settings; false if they are refused. */
static bool derive(const Settings *s, Coefficients *c)
{
    *c = (Coefficients){0};
    if (!are_in_range(s) || !are_consistent(s) || !set_norm(s, c) || !set_floor(s, c))
        return false;
    set_limits(s, c);
    c->sqrt_bound = root(s->acceleration_bound);
    c->tracking_time = s->tracking_time_constant;
    if (c->tracking_time == 0 && s->gains_i > 0) {
        if (s->gains_d > 0)
            c->tracking_time = root(s->gains_d / s->gains_i);
        else
            c->tracking_time = s->gains_p > 0 ? s->gains_p / s->gains_i : INFINITE;
    }
    if (s->gains_i > 0 && !(c->tracking_time > 0))
        return false;
    c->lost_turn = larger(s->encoder_wrap, 0);
    c->turn = s->multi_turn || c->lower > -INFINITE || c->upper < INFINITE ? REAL(0.0)
                                                                         : c->lost_turn;
    if (s->angle_wraparound)
        c->turn = TURN;
    c->fallback = clamped(s->fallback_effort, s->u_clamp_min, s->u_clamp_max);
    c->glide_ns = (int64_t)rounded(s->takeover_time / NANOSECOND);
    set_sources(s, c);
    return true;
}

/* -- The sources of the states ------------------------------------------- */

/* Return how far apart two positions are, but for whole turns [rad]. */
static Real apart_but_for_turns(Real position, Real other, Real turn)
{
    Real apart = position - other;
    if (ABS(apart) > REAL(0.5) * turn)
        apart -= turn * rounded(apart / turn);
    return ABS(apart);
}

/* Leave the present sequence of states, for the other one or for a new one. */
static void part(Sources *its, const Coefficients *c, int64_t stamp_ns, Real position, Real near)
{
    Real off = apart_but_for_turns(position, its->other, c->source_turn);
    bool is_on_time = its->has_other && stamp_ns >= its->other_ns &&
        (uint64_t)stamp_ns - (uint64_t)its->other_ns <= (uint64_t)c->window_ns;
    if (off <= near && is_on_time) {
        if (its->returns < {{ sources.returns }})
            its->returns++;
        its->usual += {{ sources.noise_share|real }} * (off - its->usual);
        if (its->returns >= {{ sources.returns }})
            its->is_split = true;
    } else if (!its->is_split) {
        its->returns = 0;
    }
    its->has_other = true;
    its->other_ns = its->stamp_ns;
    its->other = its->position;
    its->stamp_ns = its->since_ns = stamp_ns;
    its->position = position;
}

/* Take a state, and return whether there are two sources. */
static bool is_split(State *loop, int64_t stamp_ns, Real position)
{
    const Coefficients *c = &loop->own.coefficients;
    Sources *its = &loop->own.sources;
    Real apart, noise, bound;
    bool is_later, is_near;
    if (!its->has_state) {
        its->has_state = true;
        its->stamp_ns = its->since_ns = stamp_ns;
        its->position = position;
        return false;
    }
    apart = apart_but_for_turns(position, its->position, c->source_turn);
    noise = {{ sources.noise|real }} * its->usual;
    if (stamp_ns == its->stamp_ns) {
        if (apart <= larger(c->twice, noise))
            return its->is_split;
        its->doubled = {{ sources.pair }};
        part(its, c, stamp_ns, position, {{ sources.near|real }} * apart);
        return its->is_split;
    }
    bound = c->apart;
    if (its->doubled > 0) {
        its->doubled--;
        bound = c->twice;
    }
    is_near = apart <= larger(bound, noise);
    if (stamp_ns > its->stamp_ns)
        is_later = (uint64_t)stamp_ns - (uint64_t)its->stamp_ns <= (uint64_t)c->window_ns;
    else
        is_later = (uint64_t)its->stamp_ns - (uint64_t)stamp_ns <= (uint64_t)c->back_ns;
    if (is_later && is_near) {
        its->stamp_ns = stamp_ns;
        its->position = position;
        its->usual += {{ sources.noise_share|real }} * (apart - its->usual);
        if (its->returns > 0 && stamp_ns > its->since_ns &&
            (uint64_t)stamp_ns - (uint64_t)its->since_ns > (uint64_t)c->window_ns) {
            its->returns = 0;
            its->is_split = false;
        }
    } else { /* where it parted by its stamp alone, the sequences may be near each other */
        part(its, c, stamp_ns, position, is_near ? bound : {{ sources.near|real }} * apart);
    }
    return its->is_split;
}

/* -- One sample ---------------------------------------------------------- */

/* Answer a state that cannot be used: the fallback. */
static Real fault(State *loop, int64_t stamp_ns)
{
    loop->own.has_unusable = true;
    loop->own.unusable_ns = stamp_ns;
    loop->condition = {{ C }}_FAULT;
    give(loop, loop->own.coefficients.fallback);
    return loop->effort;
}

/* Answer a state of one of two sources: which of them is true cannot be told. */
static Real refuse_both(State *loop, int64_t stamp_ns)
{
    if (loop->condition != {{ C }}_CONFLICT) {
        loop->condition = {{ C }}_CONFLICT;
        {{ c }}_supersede(loop, loop->own.coefficients.fallback);
    }
    loop->own.has_unusable = true;
    loop->own.unusable_ns = stamp_ns;
    return loop->effort;
}

/* Be without time after a gap, and where the clock was set back. */
static void interrupt(State *loop, Real since)
{
    if (since != 0) {
        loop->own.is_takeover_due = true;
        if (!loop->own.encoder.has_wrapped) /* it is not known that it ever does */
            loop->own.encoder.has_position = false;
    }
}

/* Whether a state with an odd stamp is not the first one. */
static bool has_come_before(const State *loop, int64_t stamp_ns)
{
    Real timeout = loop->settings.state_timeout * SLACK;
    if (!loop->own.has_unusable || stamp_ns < loop->own.unusable_ns)
        return false;
    if (stamp_ns < loop->own.stamp_ns) /* and so was the one before */
        return true;
    return seconds(loop->own.unusable_ns, stamp_ns) <= timeout ||
        seconds(loop->own.stamp_ns, loop->own.unusable_ns) > timeout;
}

/*
 * Whether to believe a position where no joint can have come to. The first is
 * passed over, and the effort in force stays. The second is believed, as a
 * takeover, if it is where the first one was. Others are no positions at all.
 */
static bool is_believed(State *loop, int64_t stamp_ns, Real position)
{
    const Coefficients *c = &loop->own.coefficients;
    bool has_first = loop->own.is_astray;
    Real since = has_first ? seconds(loop->own.astray_ns, stamp_ns) : REAL(0.0);
    Real first = loop->own.astray;
    if (loop->own.is_takeover_due)
        return true;
    loop->own.is_astray = true;
    loop->own.astray_ns = stamp_ns;
    loop->own.astray = position;
    if (has_first && since > 0 &&
        distance(loop, position, first) <= c->step_max + c->speed_max * since) {
        loop->own.is_takeover_due = true;
        return true;
    }
    if (has_first) {
        (void)fault(loop, stamp_ns);
    } else {
        loop->own.has_unusable = true;
        loop->own.unusable_ns = stamp_ns;
    }
    return false;
}

/* Start from where the joint is, as a takeover if the loop has had it before. */
static void begin(State *loop, int64_t stamp_ns, Real wanted, Real rate, bool is_next)
{
    bool is_takeover = loop->own.is_takeover_due && loop->own.passage.has_reference;
    if (loop->own.coefficients.has_limits)
        open_stops(loop, loop->position);
    loop->own.is_takeover_due = false;
    begin_passage(loop, stamp_ns, wanted, rate);
    if (is_takeover) {
        reset_estimate(loop);
        take_over(loop, stamp_ns, is_next);
    }
}

static bool is_usable(Real number)
{
    return is_within(number, -LARGEST_POSITION, LARGEST_POSITION);
}

/* Return the effort at a position that is believed; dt [s] is 0 without a state before. */
static Real answer(State *loop, int64_t stamp_ns, Real wanted, Real rate, Real position,
    const Real *velocity, Real dt, bool is_next)
{
    Real elapsed = dt;
    if (loop->own.has_unusable) {
        loop->own.is_astray = false;
        elapsed = smaller(dt, loop->settings.control_period); /* the unseen is not integrated */
    }
    loop->position = position;
    if (loop->own.is_takeover_due || !loop->own.passage.has_reference)
        begin(loop, stamp_ns, wanted, rate, is_next);
    sample_reference(loop, stamp_ns, wanted, rate);
    loop->condition = {{ C }}_FOLLOWING;
    loop->velocity = velocity_at(loop, position, velocity, dt);
    loop->error = loop->reference_position - position;
    if (!update(loop, loop->reference_velocity - loop->velocity, elapsed,
            fading(&loop->own.fade, stamp_ns))) {
        reset_estimate(loop);
        return fault(loop, stamp_ns);
    }
    loop->own.has_stamp = true;
    loop->own.stamp_ns = stamp_ns;
    loop->own.has_unusable = false;
    return loop->effort;
}

{{ c }}_real {{ c }}_step({{ c }}_state *loop, int64_t stamp_ns,
    {{ c }}_real reference_position, {{ c }}_real reference_velocity,
    {{ c }}_real position, const {{ c }}_real *velocity)
{
    const Coefficients *c = &loop->own.coefficients;
    Encoder before;
    Real since;
    bool is_next;
    if (!loop->own.is_ready)
        return 0;
    if (is_usable(position) && is_usable(reference_position) && is_usable(reference_velocity) &&
        is_split(loop, stamp_ns, position))
        return refuse_both(loop, stamp_ns);
    if ((loop->own.has_stamp && stamp_ns == loop->own.stamp_ns) ||
        (loop->own.has_unusable && stamp_ns == loop->own.unusable_ns))
        return loop->effort;
    if (loop->settings.velocity_source != {{ C }}_VELOCITY_SOURCE_MEASURED)
        velocity = NULL;
    if (!is_usable(position) || (velocity != NULL && !is_usable(*velocity)) ||
        !is_usable(reference_position) || !is_usable(reference_velocity))
        return fault(loop, stamp_ns);
    since = loop->own.has_stamp ? seconds(loop->own.stamp_ns, stamp_ns) : REAL(0.0);
    is_next = since > 0 && since <= loop->settings.state_timeout * SLACK;
    if (since != 0 && !is_next && !has_come_before(loop, stamp_ns)) {
        loop->own.has_unusable = true; /* its stamp may be wrong */
        loop->own.unusable_ns = stamp_ns;
        return loop->effort;
    }
    if (!is_next)
        interrupt(loop, since);
    before = loop->own.encoder;
    if (loop->own.has_unwrapper)
        position = unwrapped(loop, position);
    if (!is_usable(position))
        return fault(loop, stamp_ns);
    if (is_next && ABS(position - loop->position) > c->step_max + c->speed_max * since &&
        !is_believed(loop, stamp_ns, position)) {
        loop->own.encoder = before; /* the joint was not there */
        return loop->effort;
    }
    return answer(loop, stamp_ns, reference_position, reference_velocity, position, velocity,
        is_next ? since : REAL(0.0), is_next);
}

/* -- Beginning, resetting, retuning -------------------------------------- */

bool {{ c }}_init({{ c }}_state *loop, const {{ c }}_settings_type *settings)
{
    Settings given = *settings; /* which may be the loop's own */
    *loop = (State){0};
    loop->own.is_ready = derive(&given, &loop->own.coefficients);
    if (!loop->own.is_ready)
        return false;
    loop->settings = given;
    loop->own.has_unwrapper = given.encoder_wrap > 0;
    {{ c }}_reset(loop);
    return true;
}

void {{ c }}_reset({{ c }}_state *loop)
{
    static const Passage none = {0};
    static const Fade nothing = {0};
    static const Sources unknown = {0};
    loop->condition = {{ C }}_WAITING;
    loop->integral = loop->term_p = loop->term_i = loop->term_d = 0;
    loop->position = loop->velocity = loop->error = 0;
    loop->reference_position = loop->reference_velocity = 0;
    loop->is_limited = false;
    give(loop, 0);
    reset_estimate(loop);
    reset_encoder(loop);
    loop->own.sources = unknown;
    loop->own.passage = none;
    loop->own.fade = nothing;
    loop->own.added = 0;
    loop->own.has_stamp = loop->own.has_unusable = loop->own.is_astray = false;
    loop->own.is_takeover_due = false;
}

bool {{ c }}_retune({{ c }}_state *loop, const {{ c }}_settings_type *settings)
{
    Settings before = loop->settings, *now = &loop->settings;
    Coefficients next;
    Real effort, integral;
    bool same_stops, same_source, is_on_fallback;
    if (!loop->own.is_ready || !derive(settings, &next))
        return false;
    is_on_fallback =
        (loop->condition == {{ C }}_FAULT || loop->condition == {{ C }}_CONFLICT) &&
        loop->effort == loop->own.coefficients.fallback;
    same_stops = loop->own.coefficients.has_limits && next.lower == loop->own.coefficients.lower &&
        next.upper == loop->own.coefficients.upper;
    *now = *settings;
    loop->own.coefficients = next;
    if (now->velocity_source == {{ C }}_VELOCITY_SOURCE_HOMOGENEOUS_DIFFERENTIATOR)
        same_source = now->acceleration_bound == before.acceleration_bound;
    else
        same_source = now->velocity_filter_time_constant == before.velocity_filter_time_constant;
    if (!same_source || now->velocity_source != before.velocity_source) {
        loop->own.estimate.has_position = loop->own.has_stamp; /* it goes on from here */
        loop->own.estimate.position = loop->position;
        loop->own.estimate.velocity = loop->own.has_stamp ? loop->velocity : REAL(0.0);
    }
    if (now->encoder_wrap > 0 && !loop->own.has_unwrapper) {
        loop->own.has_unwrapper = true;
        reset_encoder(loop);
    }
    effort = clamped(loop->effort, now->u_clamp_min, now->u_clamp_max);
    if (next.has_limits && loop->own.has_stamp) {
        if (!same_stops)
            open_stops(loop, loop->position);
        effort = limited(loop, effort, loop->velocity, effort, 0);
    }
    if (effort != loop->effort)
        give(loop, effort);
    if (is_on_fallback)
        give(loop, next.fallback);
    integral = loop->integral;
    loop->integral = allowed_integral(now, integral);
    if (integral != loop->integral)
        keep(loop, integral - loop->integral, loop->own.has_stamp ? loop->own.stamp_ns : 0);
    return true;
}

bool {{ c }}_set_gains({{ c }}_state *loop, {{ c }}_real p, {{ c }}_real i, {{ c }}_real d)
{
    Settings settings = loop->settings;
    settings.gains_p = p;
    settings.gains_i = i;
    settings.gains_d = d;
    return {{ c }}_retune(loop, &settings);
}

bool {{ c }}_set_degree({{ c }}_state *loop, {{ c }}_real mu)
{
    Settings settings = loop->settings;
    settings.mu = mu;
    return {{ c }}_retune(loop, &settings);
}

void {{ c }}_supersede({{ c }}_state *loop, {{ c }}_real effort)
{
    loop->own.is_takeover_due = true;
    give(loop, is_finite(effort) ? effort : loop->own.coefficients.fallback);
}
