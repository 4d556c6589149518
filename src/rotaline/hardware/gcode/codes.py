"""What the numbers of GRBL and grblHAL mean, in words."""

ERRORS = {
    1: "a word without its letter",
    2: "a number is missing or cannot be read",
    3: "the firmware does not know this $ command (jogging needs Grbl 1.1)",
    4: "a negative value where only positive ones are allowed",
    5: "homing is not enabled ($22=0)",
    7: "the settings in the board's memory could not be read",
    8: "the command is allowed only while the board is idle",
    9: "G-code is locked while the board is in alarm or jogs",
    10: "soft limits need homing to be enabled",
    11: "the line is too long",
    13: "the safety door is open",
    15: "the target is outside of the travel that the board allows",
    16: "a jog with a word that is not allowed in it",
    17: "laser mode needs a PWM output",
    18: "the board was reset meanwhile",
    20: "the firmware does not know this command",
    21: "two commands of the same group in one line",
    22: "no feed rate",
    24: "two commands that both need axis words",
    25: "a word stands twice in one line",
    26: "no axis word; perhaps the firmware has no axis of this letter",
    36: "words that no command uses; perhaps the firmware has no axis of this letter",
    39: "a value is out of range",
    43: "the feed is faster than the axis is allowed",
    45: "a limit switch is pressed",
    46: "the board wants to be homed first",
    50: "the emergency stop is pressed",
    51: "a motor driver reports a fault",
    79: "not allowed until the board has been reset after an alarm",
}

ALARMS = {
    1: "a limit switch was hit; the position is lost",
    2: "a target outside of the board's soft limits",
    3: "the board was reset while it moved; the position is lost",
    4: "the probe was not as expected",
    5: "the probe did not touch",
    6: "homing was interrupted by a reset",
    7: "homing was interrupted by the safety door",
    8: "homing failed: the limit switch did not open again; try a longer pull-off ($27), look at the wiring",
    9: "homing failed: no limit switch was found",
    10: "the emergency stop is pressed",
    11: "the board wants to be homed",
    12: "a limit switch is pressed",
    13: "the probe is protected",
    14: "the spindle (laser) output failed",
    16: "the motor drivers failed their self-test",
    17: "a motor driver reports a fault",
    18: "homing failed",
}

STATES = {
    "Run": "it moves",
    "Jog": "it moves",
    "Home": "it is homing",
    "Hold": "it is held; resume it (~) or reset it",
    "Alarm": "it is in alarm, or has not been homed since it was switched on",
    "Door": "its safety door is open",
    "Check": "it is in check mode and moves nothing; send $C",
    "Sleep": "it sleeps; switch it off and on",
    "Tool": "it waits for a tool change",
}


def error_words(code: int) -> str:
    """``error:15`` with its meaning."""
    return f"error:{code}, {ERRORS.get(code, 'see the list of the firmware')}"


def alarm_words(code: int) -> str:
    """``ALARM:1`` with its meaning."""
    return f"ALARM:{code}, {ALARMS.get(code, 'see the list of the firmware')}"
