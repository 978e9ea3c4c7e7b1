"""The levels of the mechanics: what presses, as objects with one set of questions.

`level.Level` says what every level answers; `choose.level_of` makes the one that `options.Options`
ask for. A new level is a folder here, its word in `options.Skeleton` and in `config`, and one line
in `choose`.
"""
