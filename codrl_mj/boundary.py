"""Types of values that come from outside the package, so that their types are not known here."""

from typing import Any

Argument = Any
"""Keyword argument that is passed on to a constructor of an environment, often third-party code."""
Options = Any
"""Options of an environment: a task's `NamedTuple`, or keyword arguments of any constructor."""
Action = Any
"""Action of an environment: an integer, an array, or what a third-party environment takes."""
Observation = Any
"""Observation of a third-party environment."""
Info = dict[str, Any]
"""Gymnasium's `info`, and what is nested in it: values of any type by name."""
PickledState = dict[str, Any]
"""Attributes of an object, as `pickle` and `copy` store them."""
AttributeValue = Any
"""Value of an attribute that Gymnasium's environment has, such as `gravity` or `force_mag`."""
Json = Any
"""Value that was read from a JSON file, or that can be written to one."""
JsonObject = dict[str, Any]
"""Mapping that was read from a JSON file, or that can be written to one; see `Json`."""
Figure = Any
"""Matplotlib's `Figure`. Matplotlib is imported only where a figure is drawn."""
Axes = Any
"""Matplotlib's `Axes`."""
Artist = Any
"""Part of a figure, such as a line or its legend entry."""
