"""What the site's reference says beside docstrings: comments of fields, and shapes as they are written.

An extension of griffe, which reads the code.
"""

from typing import Any

import griffe

SHAPED = ("Bool", "Float", "Int", "Key", "Num", "Shaped", "UInt8")  # jaxtyping's, as they are used here


class FieldComments(griffe.Extension):
    """Describes a class's fields by what stands behind them on their lines, such as unit and frame."""

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        """Add a section of attributes to the docstring, where the author wrote none."""
        if cls.docstring is None or "Attributes:" in cls.docstring.value:
            return
        lines = [
            f"    {name}: {comment}"
            for name, member in cls.members.items()
            if not name.startswith("_") and member.is_attribute and (comment := comment_of(member))
        ]
        if lines:
            cls.docstring.value = "\n".join([cls.docstring.value, "", "Attributes:", *lines])


class Shapes(griffe.Extension):
    """Keeps the quotes of shapes: griffe reads the N of Float[Array, "N"] as a name."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Quote the shapes in a signature."""
        for annotation in (*(one.annotation for one in func.parameters), func.returns):
            quote_shapes(annotation)

    def on_attribute(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Quote the shape of a field."""
        quote_shapes(attr.annotation)


def quote_shapes(annotation: str | griffe.Expr | None) -> None:
    """Put quotes around each shape within an annotation, where there are none."""
    if not isinstance(annotation, griffe.Expr):
        return
    for part in annotation.iterate(flat=False):
        if part is not annotation:  # a name is its own only part
            quote_shapes(part)
    if isinstance(annotation, griffe.ExprSubscript) and str(annotation.left) in SHAPED:
        inner = annotation.slice
        if isinstance(inner, griffe.ExprTuple) and len(inner.elements) == 2:
            shape = str(inner.elements[1]).strip("'\"")
            inner.elements = [inner.elements[0], f'"{shape}"']


def comment_of(member: griffe.Object | griffe.Alias) -> str:
    """What follows # on an attribute's last line."""
    if member.endlineno is None:
        return ""
    line = member.lines_collection[member.filepath][member.endlineno - 1]
    return line.partition("  # ")[2].strip()
