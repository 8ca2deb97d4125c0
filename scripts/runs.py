"""What scripts/golden, scripts/replay-campaign, scripts/ablation and scripts/results share: data sets cut and changed,
and distances."""
import os
import re


def middle(source):
    """The time half-way through a data set's ranges, s, as an option's value."""
    with open(os.path.join(source, "ranges.csv")) as file:
        rows = file.read().splitlines()
    column = rows[0].split(",").index("t_s")
    return repr(0.5 * (float(rows[1].split(",")[column]) + float(rows[-1].split(",")[column])))


def distance(covariance, error):
    """e' P^-1 e of three numbers."""
    (a, b, c), (_, e, f), (_, _, g) = covariance
    adjugate = ((e * g - f * f, c * f - b * g, b * f - c * e), (c * f - b * g, a * g - c * c, b * c - a * f),
                (b * f - c * e, b * c - a * f, a * e - b * b))
    determinant = a * adjugate[0][0] + b * adjugate[0][1] + c * adjugate[0][2]
    return sum(error[i] * adjugate[i][j] * error[j] for i in range(3) for j in range(3)) / determinant


def changed(source, target, change):
    """A copy of a data set in `target`, whose dataset.yaml is what `change` makes of its text."""
    with open(os.path.join(source, "dataset.yaml")) as file:
        text = change(file.read())
    os.makedirs(target)
    for name in os.listdir(source):
        if name != "dataset.yaml":
            os.symlink(os.path.abspath(os.path.join(source, name)), os.path.join(target, name))
    with open(os.path.join(target, "dataset.yaml"), "w") as file:
        file.write(text)
    return target


def with_sigmas(source, target, ranges, odometry):
    """`source`, or a copy of it in `target` whose dataset.yaml gives the sigmas of ranges and of odometry times a factor."""
    if ranges == 1.0 and odometry == 1.0:
        return source
    if os.path.isdir(target):
        return target

    def scaled(text):
        scale = lambda factor: lambda match: f"{match[1]}{float(match[2]) * factor:.9g}"
        text, found = re.subn(r"(range: *\{ *sigma_m: *)([0-9.e-]+)", scale(ranges), text)
        text, axes = re.subn(r"(sigma_v[xy]_mps: *|sigma_omega_radps: *)([0-9.e-]+)", scale(odometry), text)
        if (found, axes) != (1, 3):
            raise SystemExit(f"{source}/dataset.yaml does not give the sigmas of ranges and odometry as expected")
        return text

    return changed(source, target, scaled)
