"""utn-sumo: the bench on which model-based traffic-signal control meets a microscopic simulator."""

__version__ = "0.1.0"
