"""Compiled terms and slopes against plain arithmetic."""

from __future__ import annotations

import numpy as np

from latticebench.methods.engine.networks.compiled_terms import compile_terms, power


def test_terms_compiled_for_training_agree_with_plain_arithmetic():
    compiled = compile_terms(("u[n+1]**4", "sign(v[n])*u[n]", "u[n]**0.5", "1/u[n]**3"), False)
    u, ahead, v = np.array([0.5, 2.0]), np.array([-1.5, 0.2]), np.array([-0.3, 0.4])
    values = {("u", 0): u, ("u", 1): ahead, ("v", 0): v}
    found = compiled.function(*(values[slot.name, slot.offset] for slot in compiled.slots), 1.0, 2.0, 3.0, 4.0)
    np.testing.assert_allclose(found[0], ahead**4)
    np.testing.assert_allclose(found[1], [-0.5, 2.0])
    np.testing.assert_allclose(found[2], np.sqrt(u))
    np.testing.assert_allclose(found[3], u**-3.0)
    slopes = {
        slot.offset: value for (_, slot), value in zip(compiled.slopes, found[4:], strict=True) if slot.name == "u"
    }
    np.testing.assert_allclose(slopes[1], 4 * ahead**3)
    np.testing.assert_allclose(slopes[0], 2 * np.sign(v) + 1.5 / np.sqrt(u) - 12 * u**-4.0)
    assert [power(3.0, k) for k in (-2, 0, 1, 7)] == [1 / 9, 1.0, 3.0, 2187.0]
