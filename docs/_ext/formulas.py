"""Turns the equations of docstrings, which are plain text, into LaTeX."""

import re

COMMANDS = {
    "Σ": r"\sum ",
    "‖": r"\Vert ",
    "½": r"\tfrac{1}{2}",
    "≤": r"\le ",
    "×": r"\times ",
    "·": r"\cdot ",
    "−": "-",
    "μ": r"\mu ",
    "λ": r"\lambda ",
    "σ": r"\sigma ",
    "θ": r"\theta ",
    "κ": r"\kappa ",
    "δ": r"\delta ",
    "ε": r"\varepsilon ",
}
RAISED, LOWERED = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹ᵀ", "0123456789T", strict=True)), dict(zip("₀₁₂₃₄₅₆₇₈₉ᵢⱼ", "0123456789ij", strict=True))


def latex(text):
    """Returns the LaTeX of an equation; its words are upright."""
    text = re.sub(r"(\w)\u0304", r"\\bar \1", text)  # a macron
    text = re.sub(r"_(\w+)", r"_{\\mathrm{\1}}", text)
    text = re.sub(r"(?<![\\\w{])(tr|det|min|max)(?!\w)", r"\\operatorname{\1}", text)
    text = re.sub(r"\(κ/2\)", r"\\tfrac{κ}{2}", text)
    text = re.sub(r"(?<![\\\w{])([a-z]{3,})(?![\w}])", r"\\text{\1}", text)
    text = re.sub(r"([⁰-⁹¹²³ᵀ]+)", lambda found: "^{" + "".join(RAISED[each] for each in found[0]) + "}", text)
    text = re.sub(r"([₀-₉ᵢⱼ]+)", lambda found: "_{" + "".join(LOWERED[each] for each in found[0]) + "}", text)
    for sign, command in COMMANDS.items():
        text = text.replace(sign, command)
    return text
