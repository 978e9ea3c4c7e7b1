"""Where to press next: what a further curve would add to the information, at every candidate.

A candidate is a press at s up to a depth, on the midline or, of deforming cross-sections, at an
angle phi, on one of the specimens where several are fitted together. Its sensitivities come from
the residual of the fit itself, so that model, scales and scopes are the same; it observes the force
along the normal, and off the midline the side force where the study has one. Relative coordinates:
1 is a change of 100 %.

What is known is what the fit says, and would say with the press: the sandwich A^-1 B A^-1 of
`fitting.covariance` with the weights of all curves, the new one included. A press adds to A (bread)
and B (meat); with equal weights B = A, the Fisher information of normal noise (Fedorov 1972).
Bounds count as a weak prior, of the variance of a uniform distribution between them, so that
nothing is infinite where the data so far leave a combination undetermined.

Unknowns of single trials (an onset, an offset) are told apart from those that are sought: a new
press brings its own, about which nothing is known, and the measured curves keep theirs. Both are
marginalised, so that information, scores and errors are those of the other unknowns.
"""
