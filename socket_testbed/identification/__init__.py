"""The contact model, the force map, and what judges them.

- Contact model: `contact_law` says what a law is, `paper_law` and `rigid_law` are the two;
  `objective` chooses and weighs the channels of a fit, `problem` makes the programs of any law,
  `box_qp` and `refinement` solve them, `fit` and `pareto` run all of it, `contact` is the model
  that comes out and `model_file` keeps it.
- Force map, without a fit: `force_map` estimates the force on every tile, `pressure` reads it.
- Judging: of samples `plausibility` and `noise`, of a model `evaluation`, `information`,
  `engagement` and `published`, of all estimates beside their rivals `validation`.
"""
