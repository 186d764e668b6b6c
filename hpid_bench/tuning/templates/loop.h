/*
 * {{ c }}: the control loop of one joint, {{ joint }}
 *
 * Exported by hpid_ros {{ version }} from {{ source }}.
 *
 * One call for each state of the joint:
 *
 *     static {{ c }}_state loop;
 *
 *     {{ c }}_init(&loop, &{{ c }}_settings);
 *     ...
 *     effort = {{ c }}_step(&loop, stamp_ns, reference_position,
 *                           reference_velocity, position, &velocity);
 *
 * SI units; "rad" reads "m", and "N m" reads "N", where the joint is prismatic.
 * error = reference - measurement, all gains positive.
 *
 * C99. No heap, no state outside of {{ c }}_state, nothing of the C library but
 * pow, exp, log (powf, expf, logf) and what the compiler itself may call, as
 * memcpy. Calls on one state must not interrupt each other.
 *
 * To get the same numbers as Python, compile without contraction of products
 * and sums: with -std=c99, or with -ffp-contract=off. Never with -ffast-math.
 */
#ifndef {{ C }}_H
#define {{ C }}_H

#include <stdbool.h>
#include <stdint.h>

/* 0: double precision, 1: single precision; the same for all that include it. */
#ifndef {{ C }}_SINGLE
#define {{ C }}_SINGLE {{ is_single|int }}
#endif

#if {{ C }}_SINGLE
typedef float {{ c }}_real;
#define {{ C }}_REAL(number) number##f
#else
typedef double {{ c }}_real;
#define {{ C }}_REAL(number) number
#endif

#ifdef __cplusplus
extern "C" {
#endif
{% for field in fields if field.choices %}

/* {{ field.description|comment }} */
typedef enum {{ c }}_{{ field.name }} {
{% for each in field.choices %}
    {{ field.enumerator(C, each) }}{{ "," if not loop.last }}
{% endfor %}
} {{ c }}_{{ field.name }};
{% endfor %}

/*
 * The settings of a loop. They are the parameters of its controller, with their
 * names, units and ranges; a dot in a name is an underscore here.
 */
typedef struct {{ c }}_settings_type {
{% for field in fields %}
    /* {{ field.description|comment(4) }} */
    {{ c ~ "_real" if field.range else c ~ "_" ~ field.name if field.choices else "bool" }} {{ field.name }};
{% endfor %}
} {{ c }}_settings_type;

/* The settings of the joint as they were exported. */
extern const {{ c }}_settings_type {{ c }}_settings;

/* What a loop is doing. */
typedef enum {{ c }}_condition {
    {{ C }}_WAITING,   /* for the first state */
    {{ C }}_FOLLOWING, /* its reference */
    {{ C }}_FAULT,     /* the last state could not be used */
    {{ C }}_CONFLICT   /* the states come from two sources */
} {{ c }}_condition;

/* What follows from the settings: computed when they come into force. */
typedef struct {{ c }}_coefficients {
    bool is_linear;                /* the law has no norm */
    {{ c }}_real degree;           /* mu of the law, 0 where it is linear */
    {{ c }}_real error_weight;     /* of the weighted norm [1/rad^exponent] */
    {{ c }}_real error_exponent;   /* 1/(1 - mu) */
    {{ c }}_real rate_weight;      /* [s/rad] */
    {{ c }}_real p11, p22;         /* of the canonical norm [1/rad^2, s^2/rad^2] */
    {{ c }}_real slowest, fastest; /* slopes of -0.5 ln(y'Py) in ln n */
    {{ c }}_real floor;            /* least value of the norm */
    {{ c }}_real tracking_time;    /* of back calculation [s] */
    {{ c }}_real sqrt_bound;       /* sqrt(acceleration_bound) */
    bool has_limits;               /* of position, velocity or effort rate */
    {{ c }}_real lower, upper;     /* soft stops [rad], infinite for none */
    {{ c }}_real velocity_limit;   /* [rad/s], infinite for none */
    {{ c }}_real rate_limit;       /* of the effort [N m/s], infinite for none */
    {{ c }}_real k_position;       /* of the soft stops [1/s] */
    {{ c }}_real k_velocity;       /* of the soft stops [N m s/rad] */
    {{ c }}_real width;            /* of velocity, in which effort fades [rad/s] */
    {{ c }}_real step_max;         /* believable step of the position [rad] */
    {{ c }}_real speed_max;        /* ... and more for each second [rad/s] */
    {{ c }}_real turn;             /* references are told modulo this, 0 for none [rad] */
    {{ c }}_real lost_turn;        /* the first one after a reset, too [rad] */
    {{ c }}_real fallback;         /* effort after a fault, within limits [N m] */
    {{ c }}_real apart;            /* from one state to the next of one source [rad] */
    {{ c }}_real twice;            /* ... where both have one stamp [rad] */
    {{ c }}_real source_turn;      /* positions whole turns apart are the same [rad] */
    int64_t back_ns;               /* by which a stamp of one source may go back */
    int64_t window_ns;             /* between two states of one source */
    int64_t glide_ns;              /* takeover_time [ns] */
} {{ c }}_coefficients;

/* The past of an encoder that wraps around. */
typedef struct {{ c }}_encoder {
    bool has_position;
    bool has_wrapped;      /* at least once */
    {{ c }}_real position; /* as it was measured [rad] */
    {{ c }}_real turns;    /* what they add to it [rad] */
} {{ c }}_encoder;

/* The past of the velocity's estimate. */
typedef struct {{ c }}_estimate {
    bool has_position;
    {{ c }}_real position; /* [rad] */
    {{ c }}_real velocity; /* [rad/s] */
} {{ c }}_estimate;

/* What is known of the sources of the states. */
typedef struct {{ c }}_sources {
    bool is_split;         /* there are two */
    bool has_state;
    int64_t stamp_ns;      /* of the last state */
    {{ c }}_real position; /* of the last state [rad] */
    int64_t since_ns;      /* stamp of the first of its sequence */
    bool has_other;        /* there is a sequence that was left */
    int64_t other_ns;      /* stamp of its last state */
    {{ c }}_real other;    /* its position [rad] */
    int doubled;           /* states left in which stamps are taken to come twice */
    int returns;           /* to the sequence that was left */
    {{ c }}_real usual;    /* distance between two states of one sequence [rad] */
} {{ c }}_sources;

/* The passage from where the joint was onto the reference. */
typedef struct {{ c }}_passage {
    bool has_reference;      /* there is a reference */
    bool has_begun;        /* since the last reset */
    bool is_gliding;
    int64_t begin_ns;      /* of the glide */
    int64_t duration_ns;   /* of the glide */
    {{ c }}_real duration; /* of the glide [s] */
    {{ c }}_real position; /* where it begins, at rest [rad] */
    {{ c }}_real turns;    /* whole turns between reference and joint [rad] */
} {{ c }}_passage;

/* An effort that fades after a takeover, where no integral may give it. */
typedef struct {{ c }}_fade {
    {{ c }}_real effort; /* at its beginning [N m] */
    int64_t begin_ns;
    int64_t duration_ns;
} {{ c }}_fade;

/*
 * The state of a loop. A firmware may read what stands before "own"; all of it
 * is written by the functions below alone.
 */
typedef struct {{ c }}_state {
    {{ c }}_condition condition;
    {{ c }}_real effort;             /* in force [N m] */
    {{ c }}_real integral;           /* term that the next sample uses [N m] */
    {{ c }}_real term_p;             /* of the last sample, before limits [N m] */
    {{ c }}_real term_i;             /* as term_p */
    {{ c }}_real term_d;             /* as term_p */
    {{ c }}_real error;              /* reference - position [rad] */
    {{ c }}_real position;           /* continuous over an encoder's turns [rad] */
    {{ c }}_real velocity;           /* measured or estimated [rad/s] */
    {{ c }}_real reference_position; /* within the stops, gliding [rad] */
    {{ c }}_real reference_velocity; /* likewise [rad/s] */
    bool is_limited;                 /* the effort of the last sample was */
    {{ c }}_settings_type settings;  /* in force */
    struct {
        bool is_ready;          /* init has accepted settings */
        bool is_given;          /* the effort in force is not the law's */
        bool is_takeover_due;   /* the next state is a takeover */
        bool has_stamp;
        int64_t stamp_ns;       /* of the last usable state */
        bool has_unusable;
        int64_t unusable_ns;    /* of a state since then, not usable */
        bool is_astray;
        int64_t astray_ns;      /* of a state whose position jumped */
        {{ c }}_real astray;    /* that position [rad] */
        bool has_unwrapper;     /* turns are counted, now or until a retuning */
        {{ c }}_real low, high; /* stops in force [rad] */
        {{ c }}_encoder encoder;
        {{ c }}_estimate estimate;
        {{ c }}_sources sources;
        {{ c }}_passage passage;
        {{ c }}_fade fade;
        {{ c }}_real added;          /* to the terms of the last sample [N m] */
        {{ c }}_coefficients coefficients;
    } own;
} {{ c }}_state;

/*
 * Begin with these settings.
 *
 * Returns false if they are refused: a value out of its range, or values that
 * exclude each other, as Python refuses them. The loop then gives no effort.
 */
bool {{ c }}_init({{ c }}_state *loop,
    const {{ c }}_settings_type *settings);

/* Forget integral, velocity and time: the next state is the first one. */
void {{ c }}_reset({{ c }}_state *loop);

/*
 * Take one state of the joint and return the effort that answers it [N m]:
 * finite and within the limits.
 *
 * stamp_ns: when the state was measured [ns], on any clock. The time between
 *     samples is the difference of stamps. An equal stamp is a repeat, which
 *     gets the effort in force; one that comes again and again with another
 *     position is a second source's. So does one that goes back, or is later by more
 *     than state_timeout, as it may be wrong; with the one after it the loop
 *     takes over anew, from the effort in force.
 * reference_position, reference_velocity: where the joint should be [rad], and
 *     how fast [rad/s]. After init, reset and a takeover the loop glides onto
 *     it from where the joint is, in takeover_time, or longer where it would
 *     else be faster than velocity_max.
 * position: measured [rad].
 * velocity: measured [rad/s], or NULL where it is not; only looked at where
 *     velocity_source is measured.
 *
 * A state or reference that is not finite or beyond 1e9, a position where no joint
 * can have come to, and a state that makes the law's effort infinite get
 * fallback_effort; the condition tells. So do all states while they come from two
 * sources: one stamp has two positions, or positions or stamps jump to and fro.
 * When one source has ended, the loop takes over from there.
 */
{{ c }}_real {{ c }}_step({{ c }}_state *loop, int64_t stamp_ns,
    {{ c }}_real reference_position, {{ c }}_real reference_velocity,
    {{ c }}_real position, const {{ c }}_real *velocity);

/*
 * Put other settings in force from the next sample on, all at once. The integral
 * term stays, so that the effort changes by no more than the laws differ at the
 * same error.
 *
 * Returns false if they are refused, as by init: those in force stay so.
 */
bool {{ c }}_retune({{ c }}_state *loop,
    const {{ c }}_settings_type *settings);

/* Retune the gains alone: p [N m/rad], i [N m/(rad s)], d [N m s/rad]. */
bool {{ c }}_set_gains({{ c }}_state *loop, {{ c }}_real p,
    {{ c }}_real i, {{ c }}_real d);

/* Retune the homogeneity degree alone, strictly within (-0.5, 0.5). */
bool {{ c }}_set_degree({{ c }}_state *loop, {{ c }}_real mu);

/*
 * Note that the joint was given another effort [N m] than the loop's last one,
 * as by a watchdog or a stop: the next state is a takeover from it.
 */
void {{ c }}_supersede({{ c }}_state *loop, {{ c }}_real effort);

#ifdef __cplusplus
}
#endif

#endif
