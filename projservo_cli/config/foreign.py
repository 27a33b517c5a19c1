"""Values that name robots and laws of others; reading them looks nothing up but metadata."""

import json
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, WithJsonSchema, model_validator
from pydantic_core import PydanticCustomError

from projservo_cli import plugins
from projservo_cli.records import LAWS


def _law(name: str) -> str:
    target = name if name in LAWS else plugins.target_of("law", name)
    if target is None and ":" in name:
        raise ValueError("must be module:Class, such as my_laws:Law")
    if target is None:
        valid = ", ".join(map(repr, (*LAWS, *plugins.registered("law"))))
        raise PydanticCustomError("literal_error", "is not one of them", {"expected": valid})
    return target


def _plant(name: str) -> str:
    target = plugins.target_of("plant", name)
    if target is None:
        names = ", ".join(plugins.registered("plant"))
        raise ValueError(
            "must be module:Class, such as my_robot:Robot" + (f", or one of {names}" if names else "")
        )
    return target


_TARGET = {"type": "string", "pattern": plugins.TARGET}
# A registered name is stored as the class it stands for, so that a run can be read where it is not installed.
Law = Annotated[str, AfterValidator(_law), WithJsonSchema({"anyOf": [{"enum": list(LAWS)}, _TARGET]})]
PlantClass = Annotated[str, AfterValidator(_plant), WithJsonSchema({"type": "string"})]


class Options(BaseModel):
    """What the class of a plant is made with: any keys, any plain values."""

    model_config = ConfigDict(frozen=True, extra="allow")

    @model_validator(mode="after")
    def _plain(self) -> "Options":
        try:
            json.dumps(self.values(), allow_nan=False)
        except ValueError as error:
            raise ValueError("takes text, finite numbers, true, false, null, lists and mappings") from error
        return self

    def values(self) -> dict[str, Any]:
        """The options by name."""
        return dict(self.model_extra or {})


def written_out(values: dict[str, Any]) -> None:
    """Replace ``plant: module:Class`` and ``law: module:Class`` by the keys they stand for."""
    if isinstance(values.get("plant"), str):
        values["plant"] = {"use": values["plant"]}
    control = values.setdefault("control", {}) if isinstance(values.get("law"), str) else None
    if isinstance(control, dict) and "laws" not in control:
        control["laws"] = [values.pop("law")]
