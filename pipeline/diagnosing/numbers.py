"""Numbers as sentences say them."""


def number(value: float, digits: int = 3) -> str:
    """Write a number in so many digits, without an exponent where it is read without.

    >>> number(1912.3), number(-0.25), number(2.4e12)
    ('1,910', '-0.25', '2.4e+12')
    """
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if 10.0**digits <= abs(rounded) < 1e9 else f"{value:.{digits}g}"
