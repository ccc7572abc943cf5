"""What the page is answered: JSON whose texts play with nothing, whoever wrote them."""

from typing import Any

from starlette.responses import JSONResponse as PlainResponse

from gateway.core.clean_text import clean_texts


class JSONResponse(PlainResponse):
    """Starlette's, with every text as `clean_texts` makes it; NaN and infinity are null and no error of the server."""

    def render(self, content: Any) -> bytes:
        return super().render(clean_texts(content))
