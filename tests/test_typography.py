from __future__ import annotations

from urdfcal.typography import lines_of, tied


def test_numbers_keep_their_units_and_standard_deviations() -> None:
    page = '<p class="a 2 mm">0.1 % of it, +0.02 ± <data value="0.2">0.2</data> %, 4 mmol, rad/(N m)</p>'
    parts = ("2 mm", "0.1 %", "+0.02 ± <data", "</data> %", "(N m)")
    for part in parts:
        assert part.replace(" ", "\xa0") in tied(page).replace("<data\xa0", "<data ")
    assert tied(page).count("\xa0") == 6
    assert tied(page).replace("\xa0", " ") == page


def test_lines_break_between_words_alone() -> None:
    text = "the tips 0.2 mm rms apart; from /a/long/path/to/a-file.json on 1 %"
    whole = ["the tips", "  0.2 mm rms", "  apart; from", "  /a/long/path/to/a-file.json", "  on 1 %"]
    assert lines_of(text, 13, "  ") == whole
    assert lines_of("", 20, "  ") == [""]
