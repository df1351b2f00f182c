"""The search for a policy: `snakesim policy train`, in the extra `train`. See `docs/how-to/train-policies.md`.

`form` has the policy and its numbers, `episodes` runs it in environments, `search` looks for better ones, `exported`
writes it as an ONNX file that the controller `policy` takes, `curve` what came of each generation. `kept_search` has
what a search needs to go on after it was stopped.
"""
