"""Selections: a small language that selects vertices of a mesh."""

import re

import numpy as np

from ..base.checks import as_array, shown

# Relative tolerance of comparisons, because points often come from float32 files and numbers such as 0.1 from text.
_EQUAL = 1e-6

_DEEPEST = 100  # nested brackets, each of which takes three Python calls
_EXCERPT = 60  # characters of a long text that are shown before and after an error

_TOKEN = re.compile(
    r"(?P<space>\s+)|(?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<sign><=|>=|==|!=|[-+*/<>(),:])"
)


def select(mesh, text):
    """Returns the vertices that a selection describes.

        selection = term {"or" term}
        term      = factor {"and" factor}
        factor    = "not" factor | "(" selection ")" | vertices
        vertices  = sum ("<" | "<=" | "==" | "!=" | ">=" | ">") sum
                  | "all" | "boundary" | "corners"
                  | "nearest" "(" x "," y "," z ["," count] ")"
                  | "index" "(" range {"," range} ")"
                  | "part" "(" name ")"
        sum       = product {("+" | "-") product}
        product   = value {("*" | "/") value}
        value     = "x" | "y" | "z" | number | ("-" | "+") value | "(" sum ")"
        range     = index | [start] ":" [stop] [":" step]

    Comparisons are of rest points, equal within 1e-6 of the bounding box's diagonal in each coordinate. `nearest` gives the
    `count` nearest vertices, 1 by default, lower indices first among equals. Ranges are Python's without negative numbers:
    `10:20` is 10 to 19.

    Args:
        mesh: A Mesh.
        text: Such as "z == 0 and not corners", "x*x + z*z < 0.01", "nearest(0.5, 0, 1)" or "index(0, 3, 10:20)".

    Returns:
        np.ndarray: Vertex indices, sorted, int32, maybe none.

    Raises:
        ValueError: The text breaks the grammar, an index has no vertex, a value is not finite, or a closed mesh has no
            `corners`; the message gives text, column and what is allowed there.
    """
    if not isinstance(text, str):
        raise ValueError(f"selection is {text!r}; it must be a text")
    return _Reader(mesh, text).read()


def distinct_vertices(name, vertices, mesh):
    """Returns vertices (p,), int32, from a selection, sorted, or from indices, in order.

    Raises:
        ValueError: They are not whole numbers, not vertices, or repeated; the message begins with ``name``.
    """
    if isinstance(vertices, str):
        return select(mesh, vertices)
    n = len(mesh.points)
    found = as_array(vertices)
    found = found.astype(np.int32) if found.size == 0 else found
    if found.ndim != 1 or found.dtype.kind not in "iu":
        given = f"has shape {found.shape} and type {found.dtype}" if found.dtype != object else f"is {shown(vertices)}"
        raise ValueError(f"{name} {given}; it must be a list of whole numbers")
    for k in np.flatnonzero((found < 0) | (found >= n))[:1]:
        raise ValueError(f"{name}[{k}] is {found[k]}; it must lie in 0 … {n - 1}")
    values, counts = np.unique(found, return_counts=True)
    for vertex in values[counts > 1][:1]:
        raise ValueError(f"{name} names vertex {vertex} twice; each may stand once")
    return found.astype(np.int32)


class _Reader:
    """A recursive-descent parser, a method per rule, with masks (n,) of vertices."""

    def __init__(self, mesh, text):
        self.mesh, self.text, self.position, self.depth = mesh, text, 0, 0
        self.tolerance = _EQUAL * np.linalg.norm(np.ptp(mesh.points, axis=0))
        self.tokens = []
        column = 0
        while column < len(text):
            match = _TOKEN.match(text, column)
            if not match:
                self.fail(column, f"unexpected {text[column]!r}, expected a number, name, comparison or one of ( ) , : + - * /")
            if match.lastgroup != "space":
                self.tokens.append((match.lastgroup, match.group(), column))
            column = match.end()
        self.tokens.append(("end", "", len(text)))
        opened, self.after = [], {}  # the token after the end of each bracket
        for k, (_, word, _) in enumerate(self.tokens):
            if word == "(":
                opened.append(k)
            elif word == ")" and opened:
                self.after[opened.pop()] = k + 1

    def fail(self, column, why):
        first, last = max(0, column - _EXCERPT), column + _EXCERPT
        part = "…" * (first > 0) + self.text[first:last] + "…" * (last < len(self.text))
        raise ValueError(f"selection {part!r}, column {column + 1}: {why}")

    def expected(self, what):
        _, word, column = self.tokens[self.position]
        self.fail(column, f"found {shown(word)}, expected {what}" if word else f"the text ends, expected {what}")

    def accept(self, *words):
        word = self.tokens[self.position][1]
        if word not in words:
            return None
        self.position += 1
        return word

    def require(self, *words):
        return self.accept(*words) or self.expected(" or ".join(words))

    def number(self, whole=False, least=None, most=None):
        kind, word, column = self.tokens[self.position]
        if kind != "number":
            self.expected("a whole number" if whole else "a number")
        # float first, because Python converts only a few thousand digits to an int; indices are exact as floats.
        if whole and not (word.isdecimal() and least <= float(word) <= most):
            self.fail(column, f"found {shown(word)[1:-1]}, expected a whole number from {least} to {most}")
        if not whole and not np.isfinite(float(word)):
            self.fail(column, f"found {shown(word)[1:-1]}, expected a finite number")
        self.position += 1
        return int(word) if whole else float(word)

    def read(self):
        chosen = self.selection()
        if self.tokens[self.position][0] != "end":
            self.expected('"and", "or" or the end')
        return np.flatnonzero(chosen).astype(np.int32)

    def selection(self):
        chosen = self.term()
        while self.accept("or"):
            chosen = chosen | self.term()
        return chosen

    def term(self):
        chosen = self.factor()
        while self.accept("and"):
            chosen = chosen & self.factor()
        return chosen

    def factor(self):
        inverted = False
        while self.accept("not"):
            inverted = not inverted
        following = self.tokens[self.after.get(self.position, 0)][1]  # a bracket around a part of a sum is followed by a sign
        is_selection = self.tokens[self.position][1] == "(" and following[:1] not in tuple("+-*/<>=!")
        chosen = self.in_brackets(self.selection) if is_selection else self.vertices()
        return ~chosen if inverted else chosen

    def in_brackets(self, read):
        column = self.tokens[self.position][2]
        self.require("(")
        self.depth += 1
        if self.depth > _DEEPEST:
            self.fail(column, f"is {self.depth} brackets deep, must be {_DEEPEST} at most")
        found = read()
        self.require(")")
        self.depth -= 1
        return found

    def vertices(self):
        kind, word, column = self.tokens[self.position]
        if kind == "number" or word in ("x", "y", "z", "-", "+", "("):
            return self.comparison()
        word = self.accept("all", "boundary", "corners", "nearest", "index", "part")
        if word is None:
            self.expected("x, y, z, all, boundary, corners, nearest(…), index(…), part(…), not or (")
        if word == "nearest":
            return self.nearest()
        if word == "index":
            return self.index()
        if word == "part":
            return self.part()
        if word == "all":
            return self.mask(slice(None))
        try:
            return self.mask(self.mesh.boundary if word == "boundary" else self.mesh.corners())
        except ValueError as error:
            self.fail(column, str(error))

    def mask(self, vertices):
        chosen = np.zeros(len(self.mesh.points), dtype=bool)
        chosen[vertices] = True
        return chosen

    def comparison(self):
        column = self.tokens[self.position][2]
        with np.errstate(all="ignore"):
            left, sign = self.sum(), self.require("<", "<=", "==", "!=", ">=", ">")
            above, *moved = np.broadcast_to(left - self.sum(), (4, len(self.mesh.points)))
        for vertex in np.flatnonzero(~np.isfinite(above))[:1]:
            self.fail(column, f"is not finite at vertex {vertex}")
        tolerance = sum(np.abs(each - above) for each in moved)
        less, greater = above < -tolerance, above > tolerance
        return {"<": less, "<=": ~greater, "==": ~(less | greater), "!=": less | greater, ">=": ~less, ">": greater}[sign]

    # The rules of a sum return numbers, or values (4, n): at all points, and at those moved by the tolerance along x, y and z.
    def sum(self):
        value = self.product()
        while self.tokens[self.position][1][:1] in ("+", "-"):
            value = value - self.product() if self.accept("+", "-") == "-" else value + self.product()
        return value

    def product(self):
        value = self.value()
        while sign := self.accept("*", "/"):
            value = value * self.value() if sign == "*" else np.divide(value, self.value())
        return value

    def value(self):
        factor = 1.0
        while sign := self.accept("-", "+"):
            factor = -factor if sign == "-" else factor
        kind, word, _ = self.tokens[self.position]
        if word == "(":
            return factor * self.in_brackets(self.sum)
        if kind == "number":
            return factor * self.number()
        axis = "xyz".index(self.accept("x", "y", "z") or self.expected("a number, x, y, z or ("))
        return factor * (self.mesh.points[:, axis] + self.tolerance * (np.arange(4) == 1 + axis)[:, None])

    def part(self):
        self.require("(")
        first, count, _ = (self.mesh.parts or {})[self.require(*(self.mesh.parts or ["a mesh of parts"]))]
        self.require(")")
        return self.mask(slice(first, first + count))

    def nearest(self):
        self.require("(")
        point = [self.number()]
        for _ in range(2):
            self.require(",")
            point.append(self.number())
        count = 1
        if self.require(",", ")") == ",":
            count = self.number(whole=True, least=1, most=len(self.mesh.points))
            self.require(")")
        distance = np.linalg.norm(self.mesh.points - point, axis=1)
        return self.mask(np.argsort(distance, kind="stable")[:count])

    def index(self):
        n = len(self.mesh.points)
        chosen = self.mask([])
        self.require("(")
        while True:
            start = self.number(whole=True, least=0, most=n - 1) if self.next_is_number() else None
            if self.accept(":"):
                stop = self.number(whole=True, least=0, most=n) if self.next_is_number() else None
                step = self.number(whole=True, least=1, most=n) if self.accept(":") else None
                chosen[start:stop:step] = True
            elif start is None:
                self.expected("an index or a range such as 10:20")
            else:
                chosen[start] = True
            if self.require(",", ")") == ")":
                return chosen

    def next_is_number(self):
        return self.tokens[self.position][0] == "number"


def some_vertices(option, selection, mesh):
    """Returns the vertices that an option selects.

    Raises:
        ValueError: It selects none, or breaks the grammar.
    """
    vertices = mesh.select(selection)
    if not len(vertices):
        low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in (mesh.points.min(0), mesh.points.max(0)))
        raise ValueError(f"{option} names no vertex; the mesh reaches from ({low}) to ({high})")
    return vertices
