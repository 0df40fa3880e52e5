"""What methods share: equations with their derivatives, records, shooting, curves, weak form, regression, derivatives."""
