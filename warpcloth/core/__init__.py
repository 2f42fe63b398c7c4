"""Energy, gradient, Hessian, state and graph capture, which all solvers share."""
