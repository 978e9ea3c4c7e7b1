"""A skeleton of deforming cross-sections: the finest level of the mechanics.

`press.press_sections` presses it; `material` holds what it is made of. Below, in this order:
`section` (one ring), `section_tangent` (its forces and stiffness), `span` (wall between rings),
`contact` (tool on the wall), `block` (block-tridiagonal elimination), `system` (all of them
together), `solve` (path following, derivatives).
"""
