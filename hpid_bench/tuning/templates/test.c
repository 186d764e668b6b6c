/*
 * {{ c }}: replays what Python's loop answered, and prints the largest deviation
 *
 *     cc -std=c99 -O2 {{ c }}.c {{ c }}_test.c -lm -o {{ c }}_test
 *     ./{{ c }}_test
 *
 * Exit code 0 if no effort deviates by more than the tolerance.
 */
#include "{{ c }}.h"

#include "{{ c }}_golden.h"

#include <stddef.h>
#include <stdio.h>

typedef {{ c }}_real Real;

static {{ c }}_state loop;

static double answer(size_t row)
{
    Real velocity = (Real){{ c }}_golden[row].velocity;
    return (double){{ c }}_step(&loop, {{ c }}_golden[row].stamp_ns,
        (Real){{ c }}_golden[row].reference_position,
        (Real){{ c }}_golden[row].reference_velocity,
        (Real){{ c }}_golden[row].position,
        {{ c }}_golden[row].has_velocity ? &velocity : NULL);
}

static bool retune(void)
{
    return {{ c }}_set_gains(&loop, (Real){{ C }}_GOLDEN_P,
               (Real){{ C }}_GOLDEN_I, (Real){{ C }}_GOLDEN_D) &&
        {{ c }}_set_degree(&loop, (Real){{ C }}_GOLDEN_MU);
}

int main(void)
{
    size_t rows = sizeof {{ c }}_golden / sizeof {{ c }}_golden[0], row, at = 0;
    double tolerance = {{ C }}_SINGLE ? {{ C }}_GOLDEN_SINGLE : {{ C }}_GOLDEN_DOUBLE;
    double largest = 0;
    bool is_good;
    if (!{{ c }}_init(&loop, &{{ c }}_settings)) {
        puts("{{ c }}: the settings are refused");
        return 1;
    }
    for (row = 0; row < rows; row++) {
        double deviation;
        if (row == {{ C }}_GOLDEN_RETUNE && !retune()) {
            puts("{{ c }}: the retuning is refused");
            return 1;
        }
        deviation = fabs(answer(row) - {{ c }}_golden[row].effort);
        if (!(deviation <= largest)) {
            largest = deviation;
            at = row;
        }
    }
    is_good = largest <= tolerance;
    printf("{{ c }}, %s precision: largest deviation %.3g N m, in row %lu of %lu\n",
        {{ C }}_SINGLE ? "single" : "double", largest, (unsigned long)at,
        (unsigned long)rows);
    printf("allowed %.3g N m: %s\n", tolerance, is_good ? "good" : "NOT GOOD");
    return is_good ? 0 : 1;
}
