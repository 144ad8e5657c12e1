"""The pilot that chooses merge radii: a function of explicit inputs with a frozen result.

`run.run_pilot` asks a renderer for estimates through `run.PilotPasses`, a small protocol.
`radius` has all that is measured, fitted and minimised on one page.
"""
