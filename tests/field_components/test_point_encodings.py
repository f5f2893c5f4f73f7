import torch
from reference import positional_encoding

from sparsestyle_ns.field_components.positional_encoding import FrequencyEncoding, NoEncoding


def points(count: int) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(0))


def test_frequencies_are_those_of_field_coordinates() -> None:
    encoding = FrequencyEncoding(4)
    encoded = encoding.interpolate(encoding.locate(points(5)))
    assert encoded.shape == (5, encoding.get_out_dim())
    for found, point in zip(encoded, points(5), strict=True):
        expected = positional_encoding([2 * float(x) - 1 for x in point], 4)
        torch.testing.assert_close(found, torch.tensor(expected), atol=1e-5, rtol=0)


def test_no_encoding_is_no_numbers() -> None:
    encoding = NoEncoding()
    assert encoding.interpolate(encoding.locate(points(5))).shape == (5, encoding.get_out_dim()) == (5, 0)
