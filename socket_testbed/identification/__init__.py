"""Identification answers three questions, each by its own modules.

**How does the limb's motion cause forces?** The contact model. `contact` defines the laws and the
models built on them. `problem` selects and weighs the channels of a fit and turns them into
programs for any law; `solver` solves and certifies these. `fit` runs both stages and computes a
model's errors; `pareto` runs them over the trade-off, `paper` compares both with the published
figures. `model_file` reads and writes models.

**What is the force on every tile now?** The force map, which needs no fit. `force_map` estimates
it from the clusters and the wrench; `pressure` evaluates regions of it.

**How far can all this be trusted?** Validation. Samples: `checked` is the gate that judges them
once for everything else, by three rule books: `data_check` points out what to look at,
`plausibility` checks magnitude and sign, `noise` estimates the noise. Models: `information` shows
what the trial determines. All estimates: `validation` tests them on unseen data, next to simple
baselines; `survey` tests the force map by what clusters measured elsewhere in other trials of the
limb, and completes it from them. `suspension` measures the stiffness between limb and socket
without a model, `differences` compares trials.
"""
