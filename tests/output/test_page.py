from __future__ import annotations

from urdfcal.output.page import tied


def test_numbers_keep_their_units_and_standard_deviations() -> None:
    page = '<p class="a 2 mm">0.1 % of it, +0.02 ± <data value="0.2">0.2</data> %, 3 mm; 4 mmol</p>'
    assert tied(page) == (
        '<p class="a 2\xa0mm">0.1\xa0% of it, +0.02\xa0±\xa0<data value="0.2">0.2</data>\xa0%, 3\xa0mm; 4 mmol</p>'
    )
