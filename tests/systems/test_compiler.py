"""Compiled terms: NumPy, torch and plain Python agree, and derivatives are those of the text."""

import numpy as np
import pytest
import torch

from latticebench.systems.compiler import Slot, compiled, partials
from latticebench.systems.parser import TermError


def arrays_for(slots, values, t, n):
    def one(slot):
        if slot.name in ("t", "n"):
            return {"t": t, "n": n}[slot.name]
        value = values[slot.name, slot.offset]
        return value.imag.copy() if slot.part == "im" else value.real.copy()

    return [one(slot) for slot in slots]


def test_numpy_torch_and_plain_python_agree_on_a_term(case, plainly, draw_values):
    text, is_complex = case
    values, t, n = draw_values(7, is_complex)
    expected = np.array([plainly(text, {k: a[j] for k, a in values.items()}, t[j], n[j]) for j in range(4)])
    parts = [expected.real, expected.imag] if is_complex else [expected.real]
    if not is_complex:
        np.testing.assert_allclose(expected.imag, 0, atol=1e-14)
    by_numpy = compiled((text,), is_complex)
    found = by_numpy.function(*arrays_for(by_numpy.slots, values, t, n))
    assert len(found) == len(parts)
    for got, wanted in zip(found, parts, strict=True):
        np.testing.assert_allclose(np.broadcast_to(got, 4), wanted, rtol=1e-12, atol=1e-13)
    by_torch = compiled((text,), is_complex, "torch")
    assert by_torch.slots == by_numpy.slots
    tensors = [torch.tensor(a, dtype=torch.float64) for a in arrays_for(by_torch.slots, values, t, n)]
    for got, wanted in zip(by_torch.function(*tensors), parts, strict=True):
        np.testing.assert_allclose(np.broadcast_to(np.asarray(got), 4), wanted, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("is_complex", [False, True])
def test_terms_compiled_together_give_what_each_gives_alone(texts, draw_values, is_complex):
    values, t, n = draw_values(8, is_complex)
    together = compiled(tuple(texts), is_complex)
    found = together.function(*arrays_for(together.slots, values, t, n))
    assert len(found) == (1 + is_complex) * len(texts)
    for k, text in enumerate(texts):
        alone = compiled((text,), is_complex)
        for part, wanted in enumerate(alone.function(*arrays_for(alone.slots, values, t, n))):
            np.testing.assert_allclose(
                np.broadcast_to(found[part * len(texts) + k], 4), np.broadcast_to(wanted, 4), rtol=1e-13, atol=1e-14
            )


def test_partials_agree_with_central_differences(case, draw_values):
    text, is_complex = case
    values, t, n = draw_values(9, is_complex)
    whole = compiled((text,), is_complex)
    bundle, places = partials((text,), is_complex)
    arrays = arrays_for(bundle.slots, values, t, n)
    derived = {
        (part, slot): np.broadcast_to(value, 4)
        for (_, part, slot), value in zip(places, bundle.function(*arrays), strict=True)
    }
    step = 1e-5
    for position, slot in enumerate(whole.slots):
        if slot.name not in ("u", "v"):
            assert all(found != slot for _, found in derived)
            continue
        ahead, behind = ([a.copy() for a in arrays_for(whole.slots, values, t, n)] for _ in range(2))
        ahead[position] += step
        behind[position] -= step
        for part in range(1 + is_complex):
            difference = np.asarray(whole.function(*ahead)[part]) - np.asarray(whole.function(*behind)[part])
            got = derived.get((part, slot), np.zeros(4))
            np.testing.assert_allclose(got, np.broadcast_to(difference / (2 * step), 4), rtol=2e-6, atol=2e-7)


@pytest.mark.parametrize("is_complex", [False, True])
def test_numpy_and_torch_agree_on_partials(cases, draw_values, is_complex):
    texts = tuple(text for text, kind in cases if kind == is_complex)
    values, t, n = draw_values(9, is_complex)
    by_numpy, places = partials(texts, is_complex)
    by_torch, same_places = partials(texts, is_complex, "torch")
    assert (by_torch.slots, same_places) == (by_numpy.slots, places)
    arrays = arrays_for(by_numpy.slots, values, t, n)
    pairs = zip(by_torch.function(*map(torch.tensor, arrays)), by_numpy.function(*arrays), strict=True)
    for (term, _, _), (value, wanted) in zip(places, pairs, strict=True):
        found, expected = (np.broadcast_to(np.asarray(one), 4) for one in (value, wanted))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-13, err_msg=texts[term])


@pytest.mark.parametrize("text", ["u[n]**3-sin(2*u[n])*u[n+1]", "abs(u[n])**2*u[n+1]"])
def test_torch_differentiates_through_a_compiled_term_as_partials_do(text):
    bundle, places = partials((text,), False)
    draw = np.random.default_rng(3)
    arrays = [draw.uniform(-1, 1, 5) for _ in bundle.slots]
    tensors = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in arrays]
    compiled((text,), False, "torch").function(*tensors)[0].sum().backward()
    gradients = dict(zip(bundle.slots, tensors, strict=True))
    for (_, _, slot), value in zip(places, bundle.function(*arrays), strict=True):
        np.testing.assert_allclose(gradients[slot].grad.numpy(), value, rtol=1e-12)


def test_a_complex_term_on_a_real_field_is_an_error_that_says_so():
    with pytest.raises(TermError, match="complex, but the field is real"):
        compiled(("i*u[n]",), False)


def test_single_precision_tensors_stay_single():
    function = compiled(("sqrt(2)*sin(1)*u[n]",), False, "torch").function
    assert function(torch.ones(3, dtype=torch.float32))[0].dtype == torch.float32


def test_slots_sort_by_name_offset_and_part():
    assert sorted([Slot("v"), Slot("u", 1), Slot("u", -1, "re"), Slot("u", -1, "im")])[0] == Slot("u", -1, "im")
