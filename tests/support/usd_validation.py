"""Which findings of the USD validators count: one list for all files that the tests write."""

from pxr import Usd, UsdValidation

try:
    import usd_validation_nvidia
except ImportError:  # part of the test extra; the validators of usd-core do not look at extents, topology or normals
    usd_validation_nvidia = None

# usd-core: errors and warnings count, `Info` does not. usd-validation-nvidia: errors (a rule that crashed), failures
# and warnings count, `INFO` does not.
COUNTED_BY_USD = (UsdValidation.ValidationErrorType.Error, UsdValidation.ValidationErrorType.Warn)
COUNTED_BY_NVIDIA = ("ERROR", "FAILURE", "WARNING")

# (ending of the file, name of the rule, part of the message, reason). Nothing else is excused, but what an artist's stage
# had before.
EXCEPTIONS = [
    (".usda", "UsdAsciiPerformanceChecker", "", "text was asked for: one text file with all frames is large and slow"),
    ("", "IndexedPrimvarChecker", "contains repeated values", "an index takes as much room as the number it stands for"),
]


def findings(path):
    """All findings that count, without exceptions.

    Args:
        path: A USD file.

    Returns:
        list: (rule, message).
    """
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = [
        (error.GetIdentifier(), error.GetMessage())
        for error in UsdValidation.ValidationContext(validators).Validate(stage)
        if error.GetType() in COUNTED_BY_USD
    ]
    if usd_validation_nvidia is None:
        return found
    for issue in usd_validation_nvidia.ValidationEngine().validate(str(path)).issues():
        if issue.severity.name in COUNTED_BY_NVIDIA:
            found.append((issue.rule.__name__ if issue.rule else "", issue.message))
    return found


def validate(path, source=None):
    """Lists what is wrong with a file that this package wrote.

    Args:
        path: The file.
        source: The artist's stage below it: what is found there already is not ours to mend, and does not count.

    Returns:
        list: (rule, message); empty for a good file.
    """
    known = set(findings(source)) if source else set()
    excused = [(rule, part) for ending, rule, part, _ in EXCEPTIONS if str(path).endswith(ending)]
    return [
        (found, message)
        for found, message in findings(path)
        if (found, message) not in known and not any(found == rule and part in message for rule, part in excused)
    ]
