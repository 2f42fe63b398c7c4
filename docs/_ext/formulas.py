"""Turns the equations of energies, which are plain text in docstrings, into LaTeX, and lists the formulas of solvers."""

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


# What a step of each solver computes, and the meaning of letters that docstrings do not explain.
_OBJECTIVE = r"\varphi(x) = \tfrac{1}{2h^2}\Vert x - \tilde x\Vert_M^2 + U(x), \qquad \tilde x = x_n + h v_n + h^2 g"
_SWEEP = r"\Delta\lambda = (G W G^T + \tilde\alpha)^{-1}(p(y) - y{0}), {1}x \gets x + W G^T \Delta\lambda"
SOLVERS = {
    "Explicit": (
        r"v_{n+1} = v_n - h M^{-1} \nabla U(x_n) + h g, \qquad x_{n+1} = x_n + h v_{n+1}",
        "Here h is the step, M the mass matrix, U the energy of the cloth and g gravity",
    ),
    "Newton": (
        rf"(M/h^2 + \nabla^2 U(x))\, d = -\nabla\varphi(x), \qquad x \gets x + \alpha d, \\ {_OBJECTIVE}",
        "Here φ is the function that implicit Euler minimises, U the energy of the cloth, and α the length from a line search",
    ),
    "ProjectiveDynamics": (
        r"(M/h^2 + \sum k A\, G^T G)\, x \gets (M/h^2)\, \tilde x + \sum k A\, G^T p(y), \qquad y = G x",
        "Here y has the local coordinates of an element, p(y) the nearest ones without energy, k its stiffness and A its size. "
        "The matrix is constant",
    ),
    "ADMM": (
        r"z \gets \operatorname*{argmin}_z\; U(z) + \tfrac{1}{2}\Vert W(D x - z + u)\Vert^2, \qquad u \gets u + D x - z, \\ "
        r"(M/h^2 + D^T W^2 D)\, x \gets (M/h^2)\, \tilde x + D^T W^2 (z - u)",
        "Here z has the local coordinates of elements, u the multipliers, W the weights",
    ),
    "PBD": (
        _SWEEP.replace("{0}", "").replace("{1}", r"\qquad ") + r", \qquad \tilde\alpha = 1/(k A h^2)",
        "Here y = Gx has the local coordinates of an element, p(y) the nearest ones without energy, W the inverse"
        " masses. With infinite stiffness α̃ is 0",
    ),
    "HierarchicalPBD": (
        r"d_i = \sum_j \frac{d_j}{L_{ij}} \Big/ \sum_j \frac{1}{L_{ij}}, \qquad d = x - \tilde x",
        "Sweeps of [`PBD`](PBD.md) move the vertices j of a coarse level. The vertices i that the level leaves out then follow "
        "them; L are the distances between both. The last sweeps move all vertices",
    ),
    "XPBD": (
        _SWEEP.replace("{0}", r" - \tilde\alpha\lambda").replace("{1}", r"\\ \lambda \gets \lambda + \Delta\lambda, \qquad ")
        + r", \qquad \tilde\alpha = 1/(k A h^2)",
        "Here y = Gx has the local coordinates of an element, p(y) the nearest ones without energy, W the inverse"
        " masses. λ starts at 0 in each step",
    ),
    "ConstrainedDynamics": (
        r"\begin{pmatrix} \tilde M & -J^T \\ J & \tilde\alpha \end{pmatrix} \begin{pmatrix} \Delta x \\ \Delta\lambda "
        r"\end{pmatrix} = -\begin{pmatrix} M(x - \tilde x) - J^T\lambda \\ C(x) + \tilde\alpha\lambda \end{pmatrix}, \qquad "
        r"\tilde\alpha = 1/(k A h^2)",
        "Here C has the constraints, J their derivatives and λ their multipliers. M̃ is M, plus the positive part of −λ∂²C with "
        '`stabilisation="geometric-stiffness"`',
    ),
}
