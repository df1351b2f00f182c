"""The search for a policy: `snakesim train`, in the extra `train`. See `docs/environments.md`.

`form` has the policy and its numbers, `episodes` runs it in environments, `search` looks for better ones, `exported`
writes it as an ONNX file that the controller `policy` takes, `curve` what came of each generation.
"""
