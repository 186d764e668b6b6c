"""Rounding to significant digits."""

from hypothesis import given
from hypothesis import strategies as st

from hpid_ros.base.rounding import significant

DIGITS = st.integers(1, 15)


@given(st.floats(1e-300, 1e300), DIGITS)
def test_what_is_lost_is_less_than_half_of_the_last_digit(value, digits):
    found = significant(value, digits)
    assert abs(found - value) <= 0.5000001 * 10.0 ** (1 - digits) * value
    assert significant(found, digits) == found
    assert significant(-value, digits) == -found


@given(st.floats(allow_nan=False), DIGITS)
def test_a_text_of_so_many_digits_says_the_number(value, digits):
    found = significant(value, digits)
    assert float(f"{found:.{digits}g}") == found
