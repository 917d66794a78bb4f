import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from dreamer_racing.envs.drone.parameters import load_preset
from dreamer_racing.export.contract import describe_rate_loop
from dreamer_racing.export.onnx_actor import read_contract
from dreamer_racing.hil.betaflight import (
    LINKS,
    Status,
    check_dump,
    gains_unlike_training,
    print_settings,
    rate_map,
    wanted_settings,
)
from dreamer_racing.hil.betaflight.__main__ import main

CONTRACT = Path(__file__).parents[2] / "agents" / "kidney" / "contract.json"
VERSION = "# Betaflight / STM32F405 (S405) {} Jul 28 2024 / 05:09:33 (77d01ba3b) MSP API: 1.46"


@pytest.fixture
def contract():
    return read_contract(CONTRACT)


def asking(contract, *rates):
    """The contract of an actor that asks for other body rates."""
    for channel, rate in zip(contract["action"]["channels"][1:], rates, strict=True):
        channel["scale"] = rate
    return contract


def commands(lines):
    """What the CLI would do of lines pasted into it."""
    return [line for line in lines if not line.startswith("#")]


def dump_of(lines, version="4.5.1"):
    return "\n".join(["dump all", VERSION.format(version), "batch start", *commands(lines)])


def statuses(text, contract, link="crsf"):
    return {finding.wanted.name: finding.status for finding in check_dump(text, contract, link)}


def test_rates_are_rounded_up_to_what_betaflight_holds(contract):
    lines = print_settings(contract, "crsf")  # 10, 10 and 4 rad/s are 573, 573 and 229.2 deg/s
    for axis, value in (("roll", 58), ("pitch", 58), ("yaw", 23)):
        assert f"set {axis}_rc_rate = {value}" in lines and f"set {axis}_srate = {value}" in lines
        assert f"set {axis}_expo = 0" in lines
    rates = rate_map(contract)
    assert math.degrees(rates.roll) == pytest.approx(580) and math.degrees(rates.yaw) == pytest.approx(230)
    assert any(f"roll={rates.roll:.6g}" in line for line in lines), "the pilot is told"


@pytest.mark.parametrize(("degrees", "steps"), [(570.0, 57), (570.1, 58), (1990.0, 199)])
def test_whole_tens_of_degrees_stay_as_they_are(contract, degrees, steps):
    lines = print_settings(asking(contract, *3 * [math.radians(degrees)]), "crsf")
    assert f"set yaw_rc_rate = {steps}" in lines


@pytest.mark.parametrize("degrees", [1990.1, 0.0])
def test_rates_that_betaflight_cannot_hold_are_refused(contract, degrees):
    with pytest.raises(ValueError, match="body_rate_z.*1990"):
        print_settings(asking(contract, 1.0, 1.0, math.radians(degrees)), "crsf")


def test_an_actor_without_body_rates_is_refused(contract):
    contract["action"]["channels"][2]["name"] = "angle"
    with pytest.raises(ValueError, match="body_rate_y"):
        rate_map(contract)


def test_the_rate_curve_is_a_straight_line_that_ends_at_full_stick(contract):
    wanted = {each.name: each.value for each in wanted_settings(contract, "crsf")}
    for axis in ("roll", "pitch", "yaw"):
        centre, most, expo = (float(wanted[f"{axis}_{name}"]) for name in ("rc_rate", "srate", "expo"))
        for stick in (-1.0, -0.3, 0.0, 0.5, 1.0):  # Betaflight's ACTUAL rates, deg/s
            curve = abs(stick) * (stick**5 * expo / 100 + stick * (1 - expo / 100))
            rate = stick * centre * 10 + max(0.0, (most - centre) * 10) * curve
            assert rate == pytest.approx(stick * math.degrees(getattr(rate_map(contract), axis)))


@pytest.mark.parametrize("link", LINKS)
def test_every_line_can_be_pasted(contract, link):
    lines = print_settings(contract, link)
    text = "\n".join(lines)
    assert text.isascii() and "?" not in text and "\t" not in text and max(map(len, lines)) <= 120
    assert lines[-1] == "save"
    assert all(line.split()[0] in {"#", "set", "feature", "map", "aux", "rxfail", "save"} for line in lines)
    assert all(above.startswith("# ") for above, line in itertools.pairwise(lines) if line.startswith("set"))


@pytest.mark.parametrize(
    ("link", "there"),
    [
        ("crsf", ["feature -RX_MSP", "feature RX_SERIAL", "set serialrx_provider = CRSF"]),
        ("sbus", ["feature -RX_MSP", "feature RX_SERIAL", "set serialrx_provider = SBUS"]),
        ("msp", ["feature -RX_SERIAL", "feature RX_MSP"]),
        ("msp_override", ["feature -RX_MSP"]),
        ("betaflight_sitl", []),
    ],
)
def test_the_receiver_is_that_of_the_link(contract, link, there):
    lines = commands(print_settings(contract, link))
    assert [line for line in lines if "RX_" in line or "serialrx" in line] == there


def test_an_unknown_link_is_refused(contract):
    with pytest.raises(ValueError, match="one of crsf, sbus, msp, msp_override, betaflight_sitl"):
        print_settings(contract, "ppm")


@pytest.mark.parametrize("link", LINKS)
def test_each_setting_is_reported_where_it_differs_and_where_it_is_missing(contract, link):
    lines = print_settings(contract, link)
    assert set(statuses(dump_of(lines), contract, link).values()) == {Status.OK}
    for wanted in wanted_settings(contract, link):
        if wanted.line.startswith(("aux", "#")):
            continue
        flipped = {f"feature {name}": f"feature -{name}" for name in ("RX_SERIAL", "RX_MSP", "AIRMODE")}
        flipped |= {other: line for line, other in flipped.items()}
        flipped |= {f"rxfail {channel} a": f"rxfail {channel} h" for channel in range(4)}
        other = flipped.get(wanted.command, wanted.command.replace(wanted.value, "TAER1234"))
        lacking = Status.OK if wanted.absent else Status.MISSING
        for replacement, status in ((other, Status.DIFFERS), ("# nothing", lacking)):
            text = dump_of([replacement if line == wanted.command else line for line in lines])
            found = statuses(text, contract, link)
            assert found.pop(wanted.name) is status, wanted.name
            assert set(found.values()) == {Status.OK}


def test_a_difference_is_said_with_what_was_found_and_what_is_wanted(contract):
    text = dump_of(print_settings(contract, "crsf")).replace("set yaw_srate = 23", "set yaw_srate = 67")
    (wrong,) = [finding for finding in check_dump(text, contract, "crsf") if finding.status is not Status.OK]
    assert str(wrong).startswith("differs  set yaw_srate = 23") and "found 67" in str(wrong)


@pytest.mark.parametrize(
    ("name", "aux", "status"),
    [
        ("ARM", ["aux 0 0 0 1700 2100 0 0"], Status.OK),  # only AUX1 may arm
        ("ARM", ["aux 0 0 0 1700 2100 0"], Status.OK),  # before linked modes
        ("ARM", ["aux 3 0 0 1700 2100 0 0", "aux 4 0 0 900 900 0 0"], Status.OK),  # an empty slot
        ("ARM", [], Status.DIFFERS),
        ("ARM", ["aux 0 0 0 900 900 0 0"], Status.DIFFERS),
        ("ARM", ["aux 0 0 1 1700 2100 0 0"], Status.DIFFERS),
        ("ARM", ["aux 0 0 0 900 2100 0 0"], Status.DIFFERS),
        ("ARM", ["aux 0 0 0 1700 2100 0 0", "aux 1 0 3 1700 2100 0 0"], Status.DIFFERS),
        ("ARM", ["aux 0 1 0 1700 2100 0 0"], Status.DIFFERS),
        ("levelling", ["aux 1 1 1 1700 2100 0 0"], Status.OK),  # ANGLE on AUX2, which stays at 1000 µs
        ("levelling", ["aux 1 1 1 900 1300 0 0"], Status.DIFFERS),
        ("levelling", ["aux 1 2 5 900 1300 0 0"], Status.DIFFERS),
        ("levelling", ["aux 1 1 0 1700 2100 0 0"], Status.DIFFERS),  # on whenever it is armed
        ("levelling", ["aux 1 13 1 900 1300 0 0"], Status.OK),  # BEEPER
    ],
)
def test_only_aux1_arms_and_sticks_must_not_mean_angles(contract, name, aux, status):
    lines = [line for line in print_settings(contract, "crsf") if not line.startswith("aux")]
    assert statuses(dump_of(lines + aux), contract)[name] is status


@pytest.mark.parametrize(
    ("aux", "arms", "overrides"),
    [
        (["aux 0 0 2 1300 2100 0 0", "aux 1 50 4 900 1200 0 0"], Status.OK, Status.OK),  # the pilot's own switches
        (["aux 0 0 0 1700 2100 0 0"], Status.OK, Status.DIFFERS),
        (["aux 0 0 0 1700 2100 0 0", "aux 1 50 0 1700 2100 0 0"], Status.OK, Status.DIFFERS),  # on whenever it is armed
        (["aux 0 50 0 1700 2100 0 0", "aux 1 0 1 900 900 0 0"], Status.DIFFERS, Status.OK),
    ],
)
def test_beside_a_receiver_the_pilot_has_a_switch_to_arm_and_another_to_hand_over(contract, aux, arms, overrides):
    lines = [line for line in print_settings(contract, "msp_override") if not line.startswith("aux")]
    found = statuses(dump_of(lines + aux), contract, "msp_override")
    assert (found.pop("ARM by a switch"), found.pop("MSP OVERRIDE by another")) == (arms, overrides)
    assert set(found.values()) == {Status.OK}


def test_beside_a_receiver_msp_says_the_sticks_and_nothing_that_arms(contract):
    wanted = {each.name: each.value for each in wanted_settings(contract, "msp_override")}
    assert int(wanted["msp_override_channels_mask"]) == 0b1111
    assert wanted["msp_override_failsafe"] == "OFF" and "serialrx_provider" not in wanted


def test_the_selected_profiles_count(contract):
    lines = commands(print_settings(contract, "crsf"))
    sections = {each.command: each.section for each in wanted_settings(contract, "crsf")}
    rates = [line for line in lines if sections.get(line) == "rateprofile"]
    master = [line for line in lines if sections.get(line) == ""]
    other = [line.replace("58", "67") for line in rates]
    both = ["rateprofile 0", *other, "rateprofile 1", *rates]
    profile = [line for line in lines if sections.get(line) == "profile"]
    gains = ["profile 0", *[line.replace("boost = 0", "boost = 5") for line in profile], "profile 1", *profile]
    for selected, status in ((1, Status.OK), (0, Status.DIFFERS)):
        restored = ["# restore original", f"profile {selected}", *both, "# restore original", f"rateprofile {selected}"]
        found = statuses(dump_of(master + gains + restored), contract)
        assert found["roll_rc_rate"] is found["pitch_srate"] is found["throttle_boost"] is status
        assert found["yaw_rc_rate"] is found["thr_mid"] is found["min_check"] is Status.OK


@pytest.mark.parametrize("version", ["4.5.1", "2025.12.1", "2026.6.2"])
def test_what_a_diff_leaves_out_is_the_default(contract, version):
    own = ["aux 0 0 0 1700 2100 0 0", "set serialrx_provider = CRSF", "set failsafe_delay = 5", "profile 0"]
    own += ["set throttle_boost = 0", "rateprofile 0", "set roll_rc_rate = 58"]
    found = statuses("\n".join([VERSION.format(version), "defaults nosave", *own]), contract)
    wrong = {name for name, status in found.items() if status is not Status.OK}
    assert wrong == {
        *("roll_srate", "pitch_rc_rate", "pitch_srate", "yaw_rc_rate", "yaw_srate"),
        *("f_roll", "f_pitch", "f_yaw", "rc_smoothing", "yaw_spin_recovery"),
    }
    assert found["yaw_srate"] is Status.DIFFERS  # from the default, 67


def test_what_a_diff_leaves_out_is_unknown_where_defaults_are(contract):
    text = "\n".join([VERSION.format("4.4.3"), "defaults nosave", "set min_check = 1050"])
    found = statuses(text, contract)
    assert found["min_check"] is Status.OK and found["rates_type"] is found["mid_rc"] is Status.MISSING
    text = "\n".join([VERSION.format("4.5.1"), "defaults nosave", "feature GPS"])
    assert statuses(text, contract)["serialrx_provider"] is Status.MISSING  # it depends on the board


def test_the_older_name_of_the_idle_is_read_too(contract):
    lines = print_settings(contract, "crsf")
    assert any("set dshot_idle_value = 550" in line for line in lines)
    for value, status in ((550, Status.OK), (450, Status.DIFFERS)):
        older = [line.replace("set motor_idle = 550", f"set dshot_idle_value = {value}") for line in lines]
        assert statuses(dump_of(older), contract)["motor_idle"] is status


def test_comments_and_unknown_lines_are_passed_over(contract):
    more = [
        "#set min_check = 900",
        "resource MOTOR 1 C09",
        "serial UART2 64 115200 57600 0 115200",
        "set craft_name = a b",
    ]
    more += ["", "vtxtable bands 5", "feature GPS", "aux", "aux 1 x", "map", "profile", "set", "set osd_x", "batch end"]
    text = dump_of(print_settings(contract, "crsf") + more).replace("\n", "\r\n")
    assert set(statuses(text, contract).values()) == {Status.OK}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no lines"),
        ("Dear pilot,\nset it to 1050.\n", "no lines"),
        ("# INAV/MATEKF405 7.1.0 Feb 1 2024\nset min_check = 1050\n", "from INAV"),
    ],
)
def test_what_is_no_dump_is_refused(contract, text, said):
    with pytest.raises(ValueError, match=said):
        check_dump(text, contract, "crsf")


def run(monkeypatch, *arguments):
    """Exit status of the program."""
    monkeypatch.setattr(sys, "argv", ["betaflight", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        main()
    return left.value.code


def test_the_program_prints_and_checks(contract, tmp_path):
    program = [sys.executable, "-m", "dreamer_racing.hil.betaflight"]
    printed = subprocess.run([*program, "print", "--contract", CONTRACT], capture_output=True, text=True, check=True)
    assert printed.stdout.splitlines() == print_settings(contract, "crsf")
    dump = tmp_path / "dump.txt"
    dump.write_text(dump_of(printed.stdout.splitlines()))
    arguments = ["check", "--contract", CONTRACT, "--dump", dump]
    checked = subprocess.run([*program, *arguments], capture_output=True, text=True, check=False)
    count = len(wanted_settings(contract, "crsf"))
    assert checked.returncode == 0 and len(checked.stdout.splitlines()) == count + 1
    assert checked.stdout.endswith(f"0 of {count} settings differ or are missing.\n")


def test_the_exit_status_says_what_was_found(monkeypatch, tmp_path, contract, capsys):
    dump = tmp_path / "dump.txt"
    dump.write_text(dump_of(print_settings(contract, "crsf")[:-2]))
    assert run(monkeypatch, "check", "--contract", CONTRACT, "--dump", dump) == 1
    assert run(monkeypatch, "check", "--contract", CONTRACT, "--dump", dump, "--link", "sbus") == 1
    capsys.readouterr()
    dump.write_bytes(bytes(range(256)))
    broken = tmp_path / "contract.json"
    broken.write_text(json.dumps({"format": "else"}))
    for arguments in (
        ["check", "--contract", CONTRACT, "--dump", dump],
        ["check", "--contract", CONTRACT, "--dump", tmp_path / "none.txt"],
        ["check", "--contract", CONTRACT, "--dump", tmp_path],
        ["check", "--contract", tmp_path / "none.json", "--dump", dump],
        ["print", "--contract", broken],
    ):
        assert run(monkeypatch, *arguments) == 2
        said = capsys.readouterr()
        assert said.out == "" and len(said.err.splitlines()) == 1
    assert run(monkeypatch, "check", "--contract", CONTRACT) == 2
    assert run(monkeypatch, "print", "--contract", CONTRACT, "--dump", dump) == 2


def test_gains_that_training_did_not_have_are_said(contract, tmp_path):
    path, drone = tmp_path / "dump.txt", load_preset("betaflight")
    path.write_text(dump_of(["set p_roll = 45", "set p_pitch = 50", "set p_yaw = 45"]))
    assert gains_unlike_training(path, contract) == []  # of an actor of another rate loop
    (note,) = gains_unlike_training(path, {**contract, "rate_loop": describe_rate_loop(drone)})
    assert note.startswith("p_yaw is 45, and the actor was trained with 30 ± 20%")
    path.write_text(dump_of(["set p_roll = 45", "set p_pitch = 50"]).replace("dump all", "diff all"))
    (note,) = gains_unlike_training(path, {**contract, "rate_loop": describe_rate_loop(drone)})
    assert note.startswith("p_yaw is not in the text, and the actor was trained with 30 ± 20%")
