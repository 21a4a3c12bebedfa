"""What pydantic refuses, told in our words."""

import re

import pytest
from pydantic import Field

from wlr_gym.base.errors import InputError
from wlr_gym.base.settings import SettingsModel, parse_config


class Range(SettingsModel):
    low: float
    high: float


class Plan(SettingsModel):
    count: int = Field(default=1, ge=1, le=9)
    share: float = Field(default=0.5, gt=0.0, lt=1.0)
    sure: bool = False
    name: str = ""
    seeds: int | list[int] = 1
    space: dict[str, Range | list[float]] = Field(default_factory=dict)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"count": 0}, "f.yaml: count = 0: expected 1 or more"),
        ({"count": 10}, "f.yaml: count = 10: expected 9 or less"),
        ({"count": 1.5}, "f.yaml: count = 1.5: expected a whole number"),
        ({"share": 0}, "f.yaml: share = 0: expected more than 0"),
        ({"share": 1}, "f.yaml: share = 1: expected less than 1"),
        ({"share": "half"}, "f.yaml: share = 'half': expected a number"),
        ({"sure": "perhaps"}, "f.yaml: sure = 'perhaps': expected true or false"),
        ({"name": 3}, "f.yaml: name = 3: expected text"),
        ({"seeds": "all"}, "f.yaml: seeds = 'all': expected a whole number, or a list"),
        ({"seeds": [1, "b"]}, "f.yaml: seeds.1 = 'b': expected a whole number"),
        ({"space": {"rate": 3}}, "f.yaml: space.rate = 3: expected keys and values, or a list"),
        ({"space": {"rate": {"low": 1}}}, "f.yaml: 'space.rate.high' is missing"),
        ({"space": {"rate": {"low": 1, "high": 2, "lgo": 1}}}, "f.yaml: unknown key 'space.rate.lgo' (did you mean 'low'?); "),
        ({"nam": ""}, "f.yaml: unknown key 'nam' (did you mean 'name'?); valid: count, share"),
        ({"name": list(range(99))}, "f.yaml: name = [0, 1, 2, "),
        ({"count": 0, "share": 0}, "f.yaml: 2 faults\n  count = 0: expected 1 or more\n  share = 0: expected more than 0"),
        (None, "f.yaml: the file is empty; expected the keys count, share"),
        ("text", "f.yaml: 'text': expected keys and values; keys: count, share"),
    ],
)
def test_a_refusal(data, words):
    with pytest.raises(InputError, match=f"^{re.escape(words)}") as caught:
        parse_config(Plan, data, "f.yaml")
    assert max(map(len, str(caught.value).splitlines())) < 130
