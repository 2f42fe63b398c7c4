"""The filter of steps where nothing can touch."""


class NoFilter:
    """Stands for a :class:`warpcloth.contact.self_filter.SelfFilter` where cloth meets neither itself nor a mesh."""

    def launch_start(self, _base, d):
        """Launches d = 0."""
        d.zero_()

    def launch_trial(self, *_given, **_options):
        """Launches nothing."""

    launch_hold = launch_limit = launch_near_trial = launch_end = launch_trial


def filter_of(pairs):
    """Returns the filter of :class:`warpcloth.contact.self_steps.SelfSteps`, or of None."""
    return NoFilter() if pairs is None else pairs.filter
