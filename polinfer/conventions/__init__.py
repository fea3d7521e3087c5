"""Jones matrices and elements in the conventions of other packages, and back.

Nothing here switches the convention of this package (waves ``e^{i(kz - omega t)}``, an axis at angle t along
``(cos t, -sin t)``): data of another package are converted before they enter, results after they leave.

``to_<package>`` and ``from_<package>`` convert matrices; ``to_<package>_retarder`` and ``_diattenuator`` give
:class:`polinfer.Parameters` as the arguments of that package's constructors, ``from_...`` the reverse. A constructor
that a package does not have has no function here: hand over the matrix.

Component 0 is their x and component 1 their y. A y that points up there and down here is ``flip_vertical=True``: both
off-diagonal elements then change sign, which turns ``(cos t, -sin t)`` here into ``(cos t, sin t)`` there, so that
angles of axes agree, and left-handed circular light in these components is right-handed in those.
"""

from .chromatix import from_chromatix, from_chromatix_retarder, to_chromatix, to_chromatix_retarder
from .katsu import (
    from_katsu,
    from_katsu_diattenuator,
    from_katsu_retarder,
    to_katsu,
    to_katsu_diattenuator,
    to_katsu_retarder,
)
from .py_pol import (
    from_py_pol,
    from_py_pol_diattenuator,
    from_py_pol_object,
    from_py_pol_retarder,
    to_py_pol,
    to_py_pol_diattenuator,
    to_py_pol_object,
    to_py_pol_retarder,
)
from .pypolar import from_pypolar, from_pypolar_retarder, to_pypolar, to_pypolar_retarder

__all__ = [
    "from_chromatix",
    "from_chromatix_retarder",
    "from_katsu",
    "from_katsu_diattenuator",
    "from_katsu_retarder",
    "from_py_pol",
    "from_py_pol_diattenuator",
    "from_py_pol_object",
    "from_py_pol_retarder",
    "from_pypolar",
    "from_pypolar_retarder",
    "to_chromatix",
    "to_chromatix_retarder",
    "to_katsu",
    "to_katsu_diattenuator",
    "to_katsu_retarder",
    "to_py_pol",
    "to_py_pol_diattenuator",
    "to_py_pol_object",
    "to_py_pol_retarder",
    "to_pypolar",
    "to_pypolar_retarder",
]
