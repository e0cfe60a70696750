"""Identification answers three questions, each by its own modules.

**How does the limb's motion cause forces?** The contact model. `contact` defines the laws and the
models built on them. `problem` selects and weighs the channels of a fit and turns them into
programs for any law; `solver` solves and certifies these. `fit` runs both stages; `wrench` predicts
the wrench from the pose by regression, where that serves better than the springs.
`channel_errors` compares any model with what was measured. `pareto` runs fits over the trade-off,
`paper` compares both with the published figures. `model_file` reads and writes models.

**What is the force on every tile now?** The force map, which needs no fit. `force_map` estimates
it from the clusters and the wrench: `map_prior` says what is assumed before any measurement,
`map_posterior` what the measured channels make of it. `pressure` evaluates regions of it.

**How far can all this be trusted?** Whether a value is believable has one home, `checked`, the
gate that judges samples once for everything else. It has three rule books:

- `plausibility`: single values and whole channels against what a person, a socket or a wall can do:
  units, outliers, signs, a wrench without load.
- `data_check`: whole sources against each other and over time. It brings into order what other
  modules find, where every rule is one function: `unit_check` (units and frames, from sizes);
  `course_check` (reversed, late, exchanged, drifting) in the `courses` of load, clusters and limb,
  compared by `correlation`, and axis by axis in `limb_motion`; `channel_check` (missing, frozen,
  clipped, noisy); `sudden_changes` (spikes, steps, jumps); and `trials.raw_check`, which judges
  readings that no longer show in samples: raw capacitances, ratios of bridges, markers. Each
  reports defects as in `data_finding`.
- `noise`: how large the noise of a channel and the error of a measurement are. It refuses nothing.

Whether a model is believable is another question: `information` shows what the trial's motion
determines, and `validation` tests estimates on unseen data, next to simple baselines. `survey`
tests the force map by what clusters measured elsewhere in other trials of the limb, and completes
it from them; `survey_prior` makes what they tell the prior of the limb's next trial. None of the
three judges a sample. `trials.segment` selects a steady part of sound samples, and judges none
either.

`suspension` measures the stiffness between limb and socket without a model, `differences` compares
trials.
"""
