"""Identification answers three questions, each by its own modules.

**How does the limb's motion make forces?** The contact model. `contact` defines the laws and the
models that hold one. `problem` chooses and weighs the channels of a fit and turns them into
programs for any law, `solver` solves and certifies these. `fit` runs both stages and gives the
errors of a model, `pareto` runs them over the trade-off and compares with the paper. `model_file`
is a model's file.

**What is the force on every tile now?** The force map, which needs no fit. `force_map` estimates
it from the clusters and the wrench, `pressure` reads regions from it.

**How far can all this be trusted?** Judging. Of the samples: `data_check` says what to look at,
`plausibility` checks size and sign, `noise` measures the noise. Of a model: `information` says what
the trial determines of it, and how the limb sits. Of every estimate: `validation` judges it on data
it has not seen, beside simple rivals.
"""
