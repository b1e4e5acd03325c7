"""The type checker of `make test TYPES=1`: beartype, to which a whole number is a float too.

A parameter annotated as `float` takes an `int`, as PEP 484 has it; beartype alone refuses that.
"""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
