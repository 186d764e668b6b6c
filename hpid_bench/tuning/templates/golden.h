/*
 * {{ c }}: what Python's loop answers, for {{ c }}_test.c
 *
 * {{ golden.rows|length }} states of the joint with the effort that hpid_ros {{ version }} gave, in double
 * precision. Among them are a repeat, states that are not finite, a gap, jumps
 * of the position, a stamp from the future, and a clock that goes back.
 */
#ifndef {{ C }}_GOLDEN_H
#define {{ C }}_GOLDEN_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

/* Before this row the loop is retuned to these gains, then to this degree. */
#define {{ C }}_GOLDEN_RETUNE {{ golden.retune_at }}
#define {{ C }}_GOLDEN_P {{ golden.retuned.gains.p|double }}
#define {{ C }}_GOLDEN_I {{ golden.retuned.gains.i|double }}
#define {{ C }}_GOLDEN_D {{ golden.retuned.gains.d|double }}
#define {{ C }}_GOLDEN_MU {{ golden.retuned.mu|double }}

/* What an effort may deviate by in double and in single precision [N m]. */
#define {{ C }}_GOLDEN_DOUBLE {{ golden.double_tolerance|double }}
#define {{ C }}_GOLDEN_SINGLE {{ golden.single_tolerance|double }}

static const struct {
    int64_t stamp_ns;
    double reference_position; /* [rad] */
    double reference_velocity; /* [rad/s] */
    double position;           /* [rad] */
    double velocity;           /* [rad/s] */
    bool has_velocity;
    double effort; /* [N m] */
} {{ c }}_golden[] = {
{% for row in golden.rows %}
    { INT64_C({{ row.stamp_ns }}), {{ row.reference|double }}, {{ row.rate|double }},
        {{ row.position|double }}, {{ row.velocity|double }}, {{ 'false' if row.velocity is none else 'true' }},
        {{ row.effort|double }} }{{ "," if not loop.last }}
{% endfor %}
};

#endif
